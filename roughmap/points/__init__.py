"""From a laser return to a point in the map: poses, placement (eq. 1), error bodies and their shares (eq. 12, 14).

scan.py, trajectory.py     what a caller passes in: points, noise, limits; poses; checks.py: checks on arrays
place.py, propagation.py   eq. 1: points in the map frame, and their covariances; moving.py: points with times
bodies.py, doubt.py        the error body: checks on its covariance, and its cells
footprint.py, plain.py     its shares and weights; ellipse.py: the `ellipsoid` model
georeference.py            placement without a map
strided.py                 points read in place from a message's bytes
rotations.py, poly.py      quaternions; sine and arc tangent with the same bits on every machine
"""
