"""File formats, one module each: recordings in, pictures out. README.md has a table, and how to add a reader.

clouds.py      `read_cloud`, and the reader for each suffix or folder; a new format is a module and a line there
recorded.py, options.py   what readers return: scans with poses, placed points or messages; what they are told
npz.py, text.py, las.py, ply.py, pcd.py, kitti.py, cloud_folder.py, bags.py, mcaps.py   the readers
trajectories.py   poses beside clouds, and which cloud has which
crs.py         the coordinate reference system that a file states
las_header.py, laz_chunks.py, gps_time.py, lzf.py, blocks.py   parts of LAS, PCD and PLY
poses.py, stamps.py   what is wrong with the poses and stamps of scans, in words
text_form.py, text_names.py, text_words.py   how a text file is written: separator, decimals, header, words
doubts.py      what makes coordinates doubtful: no data, degrees, too few digits
pictures.py    layers as PNG
"""
