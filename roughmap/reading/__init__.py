"""Reading a map: frozen maps, coarser levels, layers, terrain and regions.

frozen.py        the frozen map: what a reader holds
layers.py        layers from a cell's own record, and the names of all layers; error_function.py: for eq. 11
terrain.py       layers that need neighbouring cells
levels.py        coarser levels; merge_cache.py keeps their tiles
region.py        a rectangle of the map as arrays
"""
