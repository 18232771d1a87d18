"""Work on recordings and recorded runs without a service.

replay.py       integrates a log again and compares; or under other settings (what-if)
replay_log.py   writes the log of a replay
building.py     a map from recordings; message_run.py: from a robot's messages; unmapped.py: why they are not in it
compare.py      two maps, layer by layer
"""
