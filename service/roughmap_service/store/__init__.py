"""The map between starts and outside memory: map.db, the spill file, snapshots and the memory limit."""
