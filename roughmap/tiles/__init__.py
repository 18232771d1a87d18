"""Storage of cells: the table of tiles, their memory, and how they leave it and return.

table.py     which tiles exist, where each is, when each changed; index.py: from tile numbers to entries
state.py     the arrays of a tile
slots.py     tiles in memory; columns.py: their columns; slabs.py: the memory itself; rows.py: the rows in use
shelf.py     the interface to storage outside memory; places.py: numbered places there; eviction.py: moving there
loading.py   stored tiles into a table
changes.py   which tiles count as changed; digest.py: digests of tiles and of the map
"""
