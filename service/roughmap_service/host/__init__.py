"""The machine the service runs on: files and locks, log lines, counters, exposure, the end of the process."""
