"""Reading a map: frozen maps, coarser levels, layers, terrain and regions.

frozen.py        the frozen map: what a reader holds; frozen_tiles.py: its tiles
layers.py        the names of all layers, and the checks of what is asked for
cell_values.py   layers from a cell's own record
trust.py         intervals and confidences, from a cell's record and its trust
functions.py     error function, arc tangent, Student's distribution: the same on every machine
levels.py        coarser levels; merge_cache.py keeps what is made of them
region.py        a rectangle of the map as arrays

all_points.py    layers of a map of all points that need neighbouring cells; terrain.py: their formulas
ground_points.py those of a map of the ground: halo.py has the cells around a tile, ground.py says which ground is
                 known, plane.py fits planes to it, overhang.py looks at what is over it, passable.py judges
"""
