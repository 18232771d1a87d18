"""The tree of transforms, and what is read from it.

rigid.py            positions and rotations of one frame in another
link.py             a child frame in its parent, over time
tree.py             all links, and the chain of them between two frames
composed_poses.py   the poses of one frame in another, link by link
covariances.py      which covariance belongs to a pose, in which axes and about which point
given_poses.py      poses of a topic: of which body, in which frame
mountings.py        where the sensors are on the robot; clouds that wait for it
missing.py          what is missing in the tree, in words
"""
