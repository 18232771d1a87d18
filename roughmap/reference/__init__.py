"""What the running update must agree with: the batch method of the paper, and a map of the ground in plain Python.

batch.py           all points at once: every cell in two passes, every layer from its formula
batch_shares.py    the cells that the points touch, and their shares
error_function.py  the error function of eq. 11
ground.py          a map of the ground, point by point, to the byte; ground_cell.py: one cell of it
ground_clearing.py what a scan clears of it, without a declared field of view
"""
