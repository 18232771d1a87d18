"""ROS topics to the keys of roughmap's Zenoh session and back, for robots on DDS; `node.py` is all of it."""
