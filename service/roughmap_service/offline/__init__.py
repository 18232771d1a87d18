"""Work on a recorded run without a service.

replay.py       integrates a log again and compares; or under other settings (what-if)
replay_log.py   writes the log of a replay
compare.py      two maps, layer by layer
"""
