"""File formats, one module each: recorded clouds in, pictures out.

clouds.py      `read_cloud`, and the reader for each suffix; a new format is a module here and a line in clouds.py
recorded.py    what readers return: scans with poses, or placed points
npz.py, text.py   the readers
poses.py, stamps.py   what is wrong with the poses and stamps of scans, in words
text_form.py, text_names.py, text_words.py   how a text file is written: separator, decimals, header, words
doubts.py      what makes coordinates doubtful: no data, degrees, too few digits
pictures.py    layers as PNG
"""
