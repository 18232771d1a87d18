"""From the network to the input queue.

    session.py         the Zenoh session, and the claim on the map's name
    subscriptions.py   subscribers and ingest queryables: key, encoding and size are checked in Zenoh's threads
    gaps.py            which messages were lost on the way, by publishers' numbers
    queue.py           the input queue: bounded, fair between robots
    admission.py       the checks before a message is logged; how a refused one is counted and shown
    streams.py         what became of each robot's and sensor's messages; losses.py: when they count as lost;
                       remedies.py: what is told then; recent.py: what happened once, within the last minute
    receipts.py        the answers to ingest requests
    ros2.py            the service as a ROS 2 node: topics of robots into the queue; ros2_checks.py: settings that
                       can't work; ros2_problems.py: what is wrong with topics, told when it lasts

A new kind of input: ARCHITECTURE.md lists all places, from its codec to `Run.take`.
"""
