"""File formats, one module each: recorded clouds in, pictures out.

clouds.py      `read_cloud`, and the reader for each suffix; a new format is a module here and a line in clouds.py
recorded.py    what readers return: scans with poses, or placed points
npz.py, text.py   the readers
pictures.py    layers as PNG
"""
