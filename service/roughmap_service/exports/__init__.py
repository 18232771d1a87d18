"""The map as files of other tools, one format a module.

sheet.py       what is written: the layers over a rectangle of cells, tile by tile or in bands of rows
cut.py         which cells of the map those are
files.py       the writer for each suffix; a new format is a module here and a line there
layer_rules.py, whole.py   which layers a format can hold; files that appear whole or not at all
served.py      the sheet of a running service; `offline/opened_map.py` has those of a map.db and of a log
geotiff.py, ascii_grid.py, picture.py, arrays.py, nav2.py, grid_map.py   rasters
qgis_style.py, wkt.py   what stands beside them: colours for QGIS, coordinate reference systems
points.py      the known cells as points, in parts
ply.py, pcd.py, las.py   clouds of cells
"""
