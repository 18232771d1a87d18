"""File formats, one module each: recordings in, pictures out. README.md has a table, and how to add a reader.

clouds.py      `read_cloud`, and the reader for each suffix or folder; a new format is a module here and a line there
recorded.py, options.py   what readers return (scans with poses, placed points, or messages), and what they are told
npz.py, text.py, las.py, ply.py, pcd.py, kitti.py, cloud_folder.py   the readers of scans and points, with
                    blocks.py          rows of points in bounded parts
                    las_header.py, laz_chunks.py, gps_time.py   parts of LAS and LAZ
                    lzf.py             the compression of PCD
                    trajectories.py    poses beside clouds, and which cloud has which
bags.py, mcaps.py   the readers of a robot's messages, with
                    bag_files.py       files of rosbag2 and of ROS 1
                    foxglove.py        Foxglove's messages as ROS messages
                    own_logs.py        roughmap's own logs
                    topics.py          which topics are a robot's
                    robot_messages.py  the messages in order, with tf
                    posed_clouds.py    clouds with the poses of a trajectory
                    damage.py          where a file is damaged
crs.py         the coordinate reference system that a file states
poses.py, stamps.py   what is wrong with the poses and stamps of scans, in words
text_form.py, text_names.py, text_words.py   how a text file is written: separator, decimals, header, words
doubts.py      what makes coordinates doubtful: no data, degrees, too few digits
pictures.py    layers as PNG
"""
