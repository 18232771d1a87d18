"""Parts of the map as ROS topics.

window.py       which cells a topic shows: those around a robot, or a box
topics.py       what one topic sends: GridMap, OccupancyGrid with its updates and GetMap, or cells as PointCloud2
publishing.py   the thread that asks for the map and publishes what has changed
"""
