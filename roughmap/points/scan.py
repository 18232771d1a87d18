"""A scan, its errors and the rules on its returns: what the caller says, checked."""

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8
from roughmap.cell import STAMP_LIMIT_NS
from roughmap.points.trajectory import float_array, matrix_of, unit_quaternions

Six = tuple[float, float, float, float, float, float]


def checked_stamp(stamp_ns: int, name: str) -> int:
    """An integer in [0, 2^32 s), else ValueError."""
    try:
        stamp = operator.index(stamp_ns)
    except TypeError as error:
        raise ValueError(f"{name}: expected an integer number of nanoseconds") from error
    if not 0 <= stamp < STAMP_LIMIT_NS:
        raise ValueError(f"{name}: expected nanoseconds in [0, 2^32 s), got {stamp}")
    return stamp


def checked_integers(value: npt.ArrayLike, shape: tuple[int, ...], name: str) -> I8:
    """Integers of this shape as contiguous int64, else ValueError."""
    array = np.asarray(value)
    if array.shape != shape or (array.dtype.kind not in "iu" and array.size):
        raise ValueError(f"{name}: expected integers of shape {shape}, got {array.dtype} of shape {array.shape}")
    if array.dtype.kind == "u" and array.size and int(array.max()) > np.iinfo(np.int64).max:
        raise ValueError(f"{name}: expected integers of 64 bits, signed")
    # Writable, because kernels are compiled for that kind of array only.
    return np.require(array, np.int64, ["C", "A", "W"])


def checked_points(points: npt.ArrayLike, name: str) -> npt.NDArray[np.floating]:
    """(N, 3) real numbers, float32 or float64 as they lie, others as float64; else ValueError."""
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers of shape (N, 3), got {array.dtype} of shape {array.shape}")
    if array.dtype not in (np.float32, np.float64) or not array.dtype.isnative:
        array = array.astype(np.float64)
    return array


def checked_stamps(stamp_ns: npt.ArrayLike, number: int) -> I8:
    """(1,) or (N,) stamps in [0, 2^32 s), else ValueError."""
    if np.ndim(stamp_ns) == 0:
        return np.array([checked_stamp(stamp_ns, "stamp_ns")], np.int64)  # type: ignore[arg-type]
    stamps = checked_integers(stamp_ns, (number,), "stamp_ns")
    if number and not (stamps.min() >= 0 and stamps.max() < STAMP_LIMIT_NS):
        raise ValueError("stamp_ns: expected nanoseconds in [0, 2^32 s)")
    return stamps


def checked_covariances(covariance: npt.ArrayLike | None, number: int, error_model: str) -> F8:
    """(N, 3, 3), or (1, 3, 3) for one that holds for all points, else ValueError; None only for "point"."""
    if covariance is None:
        if error_model != "point":
            raise ValueError(f"covariance: expected (N, 3, 3) or (3, 3), the model is {error_model}")
        return np.zeros((1, 3, 3))
    array = np.asarray(covariance)
    if array.shape not in ((number, 3, 3), (3, 3)) or array.dtype.kind not in "fiu":
        raise ValueError(
            f"covariance: expected numbers of shape ({number}, 3, 3) or (3, 3), got {array.dtype} of {array.shape}"
        )
    return np.require(array.reshape(-1, 3, 3), np.float64, ["C", "A", "W"])


@dataclass(frozen=True, eq=False)
class Scan:
    """One sweep in the sensor's frame, and how the sensor is mounted on the robot.

    ``points`` (N, 3) metres, sensor frame; 0, 0, 0 is no return. ``stamp_ns`` in [0, 2^32 s). ``offsets_ns`` (N,)
    integers: each point's own time after the stamp (None: all at the stamp). ``translation`` (3,) metres and
    ``rotation`` (4,) quaternion x, y, z, w: the sensor in the robot's frame.
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
        translation = float_array(self.translation, (3,), "Scan.translation")
        rotation = unit_quaternions(float_array(self.rotation, (4,), "Scan.rotation")[None], "Scan.rotation")[0]
        put(self, "translation", translation)
        put(self, "rotation", rotation)
        put(self, "mounting", (*matrix_of(rotation), *translation.tolist()))

    @property
    def times(self) -> I8:
        """``offsets_ns`` as kernels take them: no numbers where there are none."""
        return np.zeros(0, np.int64) if self.offsets_ns is None else self.offsets_ns


@dataclass(frozen=True)
class Noise:
    """Errors of a spherical scanner, all one sigma.

    ``range_sigma`` metres, ``range_sigma_per_m`` metres a metre of range, ``beam_sigma`` radians across the beam.
    ``mount_sigma``: six, x y z roll pitch yaw of the mounting, in the robot's axes (None: zeros).
    """

    range_sigma: float
    range_sigma_per_m: float = 0.0
    beam_sigma: float = 0.0
    mount_sigma: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for name in ("range_sigma", "range_sigma_per_m", "beam_sigma"):
            _check_number(f"Noise.{name}", getattr(self, name), 0.0, finite=True)
        mount = float_array([0.0] * 6 if self.mount_sigma is None else self.mount_sigma, (6,), "Noise.mount_sigma")
        if (mount < 0.0).any():
            raise ValueError("Noise.mount_sigma: expected six numbers that are not negative")
        object.__setattr__(self, "mount_sigma", tuple(mount.tolist()))

    @property
    def mount_variance(self) -> tuple[float, ...]:
        """The squares of ``mount_sigma``."""
        assert self.mount_sigma is not None  # noqa: S101 - set in __post_init__
        return tuple(sigma * sigma for sigma in self.mount_sigma)


@dataclass(frozen=True)
class Limits:
    """Which returns are used.

    Range within [``min_range``, ``max_range``] metres; height above the sensor (along the map's z) at most
    ``ceiling`` + ``ceiling_slope`` times the horizontal distance; bracketing poses at most ``max_pose_gap`` seconds
    apart; not inside one of the ``exclude`` boxes (xmin, ymin, zmin, xmax, ymax, zmax in the robot's frame, closed).
    """

    min_range: float = 0.0
    max_range: float = math.inf
    ceiling: float = math.inf
    ceiling_slope: float = 0.0
    max_pose_gap: float = math.inf
    exclude: Sequence[Six] = ()
    boxes: F8 = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ("min_range", "max_range", "max_pose_gap"):
            _check_number(f"Limits.{name}", getattr(self, name), 0.0)
        _check_number("Limits.ceiling", self.ceiling, -math.inf)
        _check_number("Limits.ceiling_slope", self.ceiling_slope, -math.inf, finite=True)
        boxes = np.zeros((len(self.exclude), 6))
        for row, box in enumerate(self.exclude):
            boxes[row] = float_array(box, (6,), "Limits.exclude")
        if (boxes[:, :3] > boxes[:, 3:]).any():
            raise ValueError("Limits.exclude: expected boxes xmin, ymin, zmin, xmax, ymax, zmax with min <= max")
        object.__setattr__(self, "boxes", boxes)

    @property
    def max_gap_ns(self) -> float:
        """``max_pose_gap`` in whole nanoseconds: 2.01 * 1e9 is a little less than poses 2.01 s apart are."""
        return float(np.rint(float(self.max_pose_gap) * 1e9))


def point_rules(scan: Scan, noise: Noise, limits: Limits) -> tuple[Any, ...]:
    """What the kernels take of a scan's settings.

    Mounting (12: rotation matrix, translation), beam (3), squares of ``mount_sigma`` (6), limits (4: least and
    largest range, ceiling and its slope), boxes (B, 6).
    """
    beam = float(noise.range_sigma), float(noise.range_sigma_per_m), float(noise.beam_sigma)
    numbers = float(limits.min_range), float(limits.max_range), float(limits.ceiling), float(limits.ceiling_slope)
    return scan.mounting, beam, noise.mount_variance, numbers, limits.boxes


def _check_number(name: str, value: float, least: float, *, finite: bool = False) -> None:
    kind = "finite number" if finite else "number"
    if not isinstance(value, int | float | np.number) or not value >= least or (finite and not math.isfinite(value)):
        wanted = f"a {kind}" if least == -math.inf else f"a {kind} of at least {least:g}"
        raise ValueError(f"{name}: expected {wanted}, got {value!r}")
