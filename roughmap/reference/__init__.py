"""The batch method of the paper, dividing and calculating, as the reference for the running update.

batch.py           all points at once: every cell in two passes, every layer from its formula
batch_shares.py    the cells that the points touch, and their shares
error_function.py  the error function of eq. 11
"""
