"""From where a scan looked: the sensor's place, its axes and its declared field of view."""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from roughmap.arrays import U1, Scalar
from roughmap.jit import inline
from roughmap.points.place import pose_at
from roughmap.points.poly import sinc_of_square
from roughmap.points.scan import Fov, Limits, Scan
from roughmap.points.trajectory import Trajectory

Three = tuple[float, float, float]

Edges = tuple[bool, float, float, float, float, float, float]
"""A field of view for the kernels: declared; sine and cosine of its upper and lower edge; diamond angles of its left
and right edge, counted from the x axis to either side."""


class Viewpoint(NamedTuple):
    """``origin``: the sensor in the map frame, metres. ``axes`` (9): rotation from the sensor's frame to the map's, row
    by row. ``edges``: its field of view."""

    origin: Three
    axes: tuple[float, ...]
    edges: Edges


def viewpoint_of(scan: Scan, trajectory: Trajectory, limits: Limits, reason: U1) -> Viewpoint:
    """Return where a scan looked from at the time of the accepted point of lowest index.

    ``reason`` (N,): what phase one says of the scan's points; one at least is accepted.
    """
    first = int(np.argmin(reason))
    stamp = scan.stamp_ns if scan.offsets_ns is None else scan.stamp_ns + int(scan.offsets_ns[first])
    _, pose = pose_at(trajectory.arrays, limits.max_gap_ns, stamp)
    r, t, m = pose[:9], pose[9:12], scan.mounting
    # In plain floats and in the order of `propagation.rotate`.
    origin = tuple(t[k] + (r[3 * k] * m[9] + r[3 * k + 1] * m[10] + r[3 * k + 2] * m[11]) for k in range(3))
    axes = tuple(
        r[3 * k] * m[c] + r[3 * k + 1] * m[3 + c] + r[3 * k + 2] * m[6 + c] for k in range(3) for c in range(3)
    )
    return Viewpoint((origin[0], origin[1], origin[2]), axes, edges_of(limits.fov))


@lru_cache
def edges_of(fov: Fov | None) -> Edges:
    """Return the edges of a field of view in degrees up, down, left and right."""
    if fov is None:
        return False, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0
    up, down, left, right = (float(edge) for edge in fov)
    return True, _sine(up), _sine(90.0 - up), _sine(down), _sine(90.0 - down), _side(left), _side(right)


def _sine(degrees: float) -> float:
    """The sine of -90 to 90 degrees; exactly 0 for 0."""
    radians = degrees * (math.pi / 180.0)
    return radians * float(sinc_of_square(radians * radians))


def _side(degrees: float) -> float:
    """The diamond angle of 0 to 180 degrees, 0 to 2; see `is_inside`."""
    c, s = _sine(90.0 - degrees), _sine(degrees if degrees <= 90.0 else 180.0 - degrees)
    return 1.0 - c / (abs(c) + s)


@inline
def is_inside(axes: Scalar, edges: Scalar, x: Scalar, y: Scalar, z: Scalar) -> Scalar:
    """Whether a point x, y, z from the sensor, in map axes, is in its field of view.

    Angles are compared by what grows with them: the elevation by sines and cosines, the angle from the x axis by the
    diamond angle 1 - x / (|x| + |y|), which is 0 ahead and 2 behind.
    """
    _, sin_up, cos_up, sin_down, cos_down, left, right = edges
    ahead = axes[0] * x + axes[3] * y + axes[6] * z
    aside = axes[1] * x + axes[4] * y + axes[7] * z
    above = axes[2] * x + axes[5] * y + axes[8] * z
    flat = math.sqrt(ahead * ahead + aside * aside)
    angle = 1.0 - ahead / (abs(ahead) + abs(aside))
    level = (above * cos_up <= flat * sin_up) & (-above * cos_down <= flat * sin_down)
    return level & (angle <= (left if aside >= 0.0 else right))
