"""Reading a map: frozen maps, coarser levels, layers, terrain and regions.

frozen.py        the frozen map: what a reader holds
layers.py        the names of all layers, and the checks of what is asked for
cell_values.py   layers from a cell's own record
terrain.py       layers that need neighbouring cells
levels.py        coarser levels; merge_cache.py keeps their tiles
region.py        a rectangle of the map as arrays
"""
