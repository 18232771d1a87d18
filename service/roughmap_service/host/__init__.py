"""The machine that the service runs on.

disk.py        files that survive a power cut; locks.py: one service for each log and store
counters.py    counts since the start; log_lines.py: the lines on stderr
log_growth.py  how fast the log grows, and how that is said
exposure.py    who can reach the Zenoh session; ending.py: the time limit of a shutdown
"""
