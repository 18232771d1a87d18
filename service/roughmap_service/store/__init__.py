"""The map between starts, and outside memory.

map_db.py         the store `map.db`: tiles and one cut of the run
snapshots.py      writes cuts in a thread of its own; a run -> a cut and back
stored_tiles.py   tiles of the store, read when they are first needed
spill.py          the spill file: the core's shelf
memory_limit.py   moves tiles out of memory at `map.memory_limit`
"""
