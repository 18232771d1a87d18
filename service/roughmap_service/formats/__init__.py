"""A file a format: recorded clouds in, pictures out.

clouds.py      `read_cloud`, and the reader for each suffix: a new format is a module and a line there
recorded.py    what readers return: scans with poses, or placed points
npz.py, text.py   the readers
pictures.py    layers as PNG
"""
