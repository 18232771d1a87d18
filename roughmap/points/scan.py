"""A scan, its measurement noise and the limits on its returns: the caller's input, checked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8
from roughmap.points.checks import (
    checked_floats,
    checked_integers,
    checked_number,
    checked_points,
    checked_stamp,
    checked_time,
)
from roughmap.points.rotations import matrix_of, unit_quaternions

Six = tuple[float, float, float, float, float, float]

Fov = tuple[float, float, float, float]
"""A field of view, degrees up, down, left and right of the sensor's x axis."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep in the sensor's frame, with the sensor's mounting on the robot.

    ``points`` (N, 3) metres, sensor frame; 0, 0, 0 means no return. ``stamp_ns`` in [0, 2^32 s). ``offsets_ns`` (N,)
    integers: the time of each point after the stamp (None: all at the stamp). ``translation`` (3,) metres and
    ``rotation`` (4,) quaternion x, y, z, w: the sensor in the robot's frame. ValueError for anything else.
    """

    points: npt.NDArray[np.floating]
    stamp_ns: int
    offsets_ns: I8 | None = None
    translation: npt.ArrayLike = (0.0, 0.0, 0.0)
    rotation: npt.ArrayLike = (0.0, 0.0, 0.0, 1.0)
    mounting: tuple[float, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "points", checked_points(self.points, "Scan.points"))
        put(self, "stamp_ns", checked_stamp(self.stamp_ns, "Scan.stamp_ns"))
        if self.offsets_ns is not None:
            put(self, "offsets_ns", checked_integers(self.offsets_ns, (len(self.points),), "Scan.offsets_ns"))
        translation = checked_floats(self.translation, (3,), "Scan.translation")
        rotation = unit_quaternions(checked_floats(self.rotation, (4,), "Scan.rotation")[None], "Scan.rotation")[0]
        put(self, "translation", translation)
        put(self, "rotation", rotation)
        put(self, "mounting", (*matrix_of(rotation), *translation.tolist()))

    @property
    def times(self) -> I8:
        """``offsets_ns`` for the kernels: an empty array instead of None."""
        return np.zeros(0, np.int64) if self.offsets_ns is None else self.offsets_ns


@dataclass(frozen=True)
class Noise:
    """Errors of a spherical scanner, each one sigma.

    ``range_sigma`` metres; ``range_sigma_per_m`` metres per metre of range; ``range_sigma_per_m2`` metres per square
    metre: a stereo camera's error grows so. A range's sigma is the sum. ``beam_sigma`` radians across the beam;
    ``mount_sigma``: x y z roll pitch yaw of the mounting, metres and radians, in the robot's axes (None: zeros).
    ``pose_error_time``: seconds, above 0, over which the errors of the robot's poses stay alike.
    """

    range_sigma: float
    range_sigma_per_m: float = 0.0
    beam_sigma: float = 0.0
    mount_sigma: Sequence[float] | None = None
    pose_error_time: float = 5.0
    range_sigma_per_m2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("range_sigma", "range_sigma_per_m", "range_sigma_per_m2", "beam_sigma"):
            checked_number(f"Noise.{name}", getattr(self, name), 0.0, finite=True)
        mount = checked_floats([0.0] * 6 if self.mount_sigma is None else self.mount_sigma, (6,), "Noise.mount_sigma")
        if (mount < 0.0).any():
            raise ValueError("Noise.mount_sigma: expected six numbers of at least 0")
        checked_time("Noise.pose_error_time", self.pose_error_time)
        object.__setattr__(self, "mount_sigma", tuple(mount.tolist()))

    @property
    def mount_variance(self) -> tuple[float, ...]:
        """``mount_sigma`` squared."""
        assert self.mount_sigma is not None  # noqa: S101 - set in __post_init__
        return tuple(sigma * sigma for sigma in self.mount_sigma)


@dataclass(frozen=True)
class Limits:
    """Which returns are used.

    The range must lie in [``min_range``, ``max_range``] metres. The height above the sensor, along the map's z, must be
    at most ``ceiling`` + ``ceiling_slope`` times the horizontal distance. The poses before and after the point must be
    at most ``max_pose_gap`` seconds apart. The point must lie outside every box of ``exclude``: closed boxes xmin,
    ymin, zmin, xmax, ymax, zmax in the robot's frame.

    ``fov``, the sensor's field of view, rejects nothing. In it, nothing stands in a direction without a return if the
    scan has returns at about that elevation, or none higher (`RoughMap.add_scan` with ``clear``). Degrees up and down
    in [0, 90], left and right in [0, 180], from the sensor's x axis. None: a direction without a return says nothing.
    """

    min_range: float = 0.0
    max_range: float = math.inf
    ceiling: float = math.inf
    ceiling_slope: float = 0.0
    max_pose_gap: float = math.inf
    exclude: Sequence[Six] = ()
    fov: Fov | None = None
    boxes: F8 = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("min_range", "max_range", "max_pose_gap"):
            checked_number(f"Limits.{name}", getattr(self, name), 0.0)
        checked_number("Limits.ceiling", self.ceiling, -math.inf)
        checked_number("Limits.ceiling_slope", self.ceiling_slope, -math.inf, finite=True)
        boxes = np.zeros((len(self.exclude), 6))
        for row, box in enumerate(self.exclude):
            boxes[row] = checked_floats(box, (6,), "Limits.exclude")
        if (boxes[:, :3] > boxes[:, 3:]).any():
            raise ValueError("Limits.exclude: expected boxes xmin, ymin, zmin, xmax, ymax, zmax with min <= max")
        object.__setattr__(self, "boxes", boxes)
        if self.fov is not None:
            fov = checked_floats(self.fov, (4,), "Limits.fov")
            if (fov < 0.0).any() or (fov > (90.0, 90.0, 180.0, 180.0)).any():
                raise ValueError("Limits.fov: expected degrees up, down in [0, 90] and left, right in [0, 180]")
            object.__setattr__(self, "fov", tuple(fov.tolist()))

    @property
    def squares(self) -> tuple[float, float]:
        """The least and the largest square of a range within the limits.

        Square roots are correctly rounded, and so grow with the square: comparing squares with these equals comparing
        their roots with the limits.
        """
        low, high = float(self.min_range), float(self.max_range)
        least, most = low * low, high * high
        while least > 0.0 and math.sqrt(math.nextafter(least, 0.0)) >= low:
            least = math.nextafter(least, 0.0)
        while math.sqrt(least) < low:
            least = math.nextafter(least, math.inf)
        while most < math.inf and math.sqrt(math.nextafter(most, math.inf)) <= high:
            most = math.nextafter(most, math.inf)
        while math.sqrt(most) > high:
            most = math.nextafter(most, 0.0)
        return least, most

    @property
    def max_gap_ns(self) -> float:
        """``max_pose_gap`` in nanoseconds, rounded: 2.01 * 1e9 as a float lies just below 2,010,000,000."""
        return float(np.rint(float(self.max_pose_gap) * 1e9))


def scan_rules(scan: Scan, noise: Noise, limits: Limits) -> tuple[Any, ...]:
    """Pack a scan's mounting, noise and limits for the kernels.

    Returns mounting (12: rotation matrix, translation), beam (4), ``mount_sigma`` squared (6), limits (4:
    `Limits.squares`, ceiling and its slope) and boxes (B, 6).
    """
    beam = (
        float(noise.range_sigma), float(noise.range_sigma_per_m), float(noise.beam_sigma),
        float(noise.range_sigma_per_m2),
    )  # fmt: skip
    numbers = *limits.squares, float(limits.ceiling), float(limits.ceiling_slope)
    return scan.mounting, beam, noise.mount_variance, numbers, limits.boxes
