"""The map as files of other tools, one format a module.

sheet.py       what is written: the layers over a rectangle of cells, tile by tile or in bands of rows
files.py       `write`, and the writer for each suffix; a new format is a module here and a line there
geotiff.py, ascii_grid.py, picture.py, arrays.py, nav2.py, grid_map.py   rasters
points.py      the known cells as points, in parts
ply.py, pcd.py, las.py   clouds of cells
"""
