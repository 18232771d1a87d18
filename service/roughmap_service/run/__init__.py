"""The rules of a run: what each logged message does to it. No network, no disk, no clock.

    run.py          `Run`: take a message, decide, place, follow an event; the way of a cloud in one screen
    decoding.py     a message's bytes -> cloud, odometry or transform
    point_times.py  how the times of a sensor's points are read
    inbox.py        logged clouds that wait for their poses: which is decided next, and how
    poses.py        a robot's poses and transforms; pose_algebra.py turns them
    placing.py      a cloud's points -> the map's frame and tiles
    duplicates.py   messages that were logged before
    fold.py         a log's records -> a run, in a replay and after a restart
    settings.py     the configuration, unpacked; metadata.py: what a log file says of its run
    view.py         the map behind its lock: what readers see

All of them may be imported from higher rooms.
"""
