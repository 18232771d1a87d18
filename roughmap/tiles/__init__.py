"""Storage of cells: the table of tiles, their memory, and how they leave it and return.

table.py     which tiles exist, where each is, when each changed; index.py: from tile numbers to entries
slots.py     tiles in memory
shelf.py     the interface to storage outside memory; places.py: numbered places there; eviction.py: moving there
loading.py   stored tiles into a table
changes.py   which tiles count as changed; digest.py: digests of tiles and of the map
"""
