"""ROS 2 without ROS: its messages, its transforms, and its two wire formats over Zenoh.

wire/          keys, liveliness tokens, QoS and attachments of rmw_zenoh and zenoh-bridge-ros2dds
messages/      CDR from and to the messages of roughmap's contract
tf/            the tree of transforms: mounting of sensors, poses of the robot
feed.py        one robot: ROS messages in, messages of the contract out; the same live and from a bag
heard.py       when messages of a topic came
bridge.py      what is subscribed and published, on either kind of keys
out/           the map as GridMap, OccupancyGrid and PointCloud2, and the service GetMap
node/          an rclpy node in one file, as a ROS package: for robots on DDS without a bridge
"""
