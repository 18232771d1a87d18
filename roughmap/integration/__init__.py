"""From points to cells: the two phases of an `add`, and the ordered update of cells (eq. 5, 13-16).

phases.py        both phases; start here
geometry.py      phase one: the points of a call, checked
blocks.py        phase one: kernels that go over blocks of points, up to their tiles
tile_update.py   phase two: the cells of each tile, queued in the order of the points; drains.py: the queue's updates
cell_update.py   one point in one cell; trust_update.py: its trust; column_update.py: a point off the ground
clearing.py      what a scan saw through is no longer there: range_image.py, from viewpoint.py
workspace.py     memory that is reused from scan to scan, and the threads
"""
