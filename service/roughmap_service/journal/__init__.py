"""The recorded run, in MCAP files: written, read, repaired and trimmed."""
