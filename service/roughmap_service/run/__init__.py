"""The rules of a run: what each logged message does to it. No network, no disk, no clock.

    run.py          `Run`: take a message, decide, place, follow an event; the way of a cloud in one screen
    decoding.py     a message's bytes -> cloud, odometry or transform
    inbox.py        logged clouds that wait for their poses: which is decided next, and how
    robot.py        one robot: what its messages lead to, with
                    odometry_clock.py  which odometry is believed, by arrival and stamp
                    covariances.py     what its covariance means
                    leaps.py           poses that no motion explains
                    habits.py          what is odd about poses that are taken
                    transforms.py      transforms to the map frame
                    mountings.py       where sensors are mounted by transforms
                    poses.py           the buffer of its poses; pose_algebra.py turns them
                    sensor_clock.py    which clouds' stamps are believed
                    rules_1.py         how poses were taken in logs of the first version
    sensor_times.py how the times of each sensor's points are read; point_times.py finds their form
    placing.py      a cloud's points -> the map's frame and tiles; returns.py: points that are none
    keeping.py      which tiles the map no longer keeps
    duplicates.py   messages that were logged before
    fold.py         a log's records -> a run, in a replay and after a restart
    settings.py     the configuration, unpacked; metadata.py: what a log file says of its run
    view.py         the map behind its lock: what readers see

All of them may be imported from higher rooms.
"""
