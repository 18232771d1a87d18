"""Checks on the arrays and numbers that a caller passes in."""

import math
import operator
from typing import Any

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8
from roughmap.cell import STAMP_LIMIT_NS


def checked_stamp(stamp_ns: int, name: str) -> int:
    """Return an integer in [0, 2^32 s), else raise ValueError."""
    try:
        stamp = operator.index(stamp_ns)
    except TypeError as error:
        raise ValueError(f"{name}: expected an integer number of nanoseconds") from error
    if not 0 <= stamp < STAMP_LIMIT_NS:
        raise ValueError(f"{name}: expected nanoseconds in [0, 2^32 s), got {stamp}")
    return stamp


def checked_stamps(stamp_ns: npt.ArrayLike, number: int) -> I8:
    """Return one stamp as (1,), or one for each of ``number`` points, in [0, 2^32 s); else raise ValueError."""
    if np.ndim(stamp_ns) == 0:
        return np.array([checked_stamp(stamp_ns, "stamp_ns")], np.int64)  # type: ignore[arg-type]
    stamps = checked_integers(stamp_ns, (number,), "stamp_ns")
    if number and not (stamps.min() >= 0 and stamps.max() < STAMP_LIMIT_NS):
        raise ValueError("stamp_ns: expected nanoseconds in [0, 2^32 s)")
    return stamps


def checked_integers(value: npt.ArrayLike, shape: tuple[int, ...], name: str) -> I8:
    """Return integers of this shape as contiguous int64, else raise ValueError."""
    array = np.asarray(value)
    if array.shape != shape or (array.dtype.kind not in "iu" and array.size):
        raise ValueError(f"{name}: expected integers of shape {shape}, got {array.dtype} of shape {array.shape}")
    if array.dtype.kind == "u" and array.size and int(array.max()) > np.iinfo(np.int64).max:
        raise ValueError(f"{name}: expected signed 64-bit integers")
    # Writable, because the kernels are compiled for writable arrays only.
    return np.require(array, np.int64, ["C", "A", "W"])


def checked_number(name: str, value: float, least: float, *, finite: bool = False) -> None:
    """Raise ValueError unless ``value`` is a number of at least ``least``, and finite where that is asked."""
    kind = "finite number" if finite else "number"
    if not isinstance(value, int | float | np.number) or not value >= least or (finite and not math.isfinite(value)):
        wanted = f"a {kind}" if least == -math.inf else f"a {kind} of at least {least:g}"
        raise ValueError(f"{name}: expected {wanted}, got {value!r}")


def checked_time(name: str, value: float) -> None:
    """Raise ValueError unless ``value`` is a finite number of seconds above 0."""
    checked_number(name, value, 0.0, finite=True)
    if value == 0.0:
        raise ValueError(f"{name}: expected a number of seconds above 0, got {value!r}")


def checked_each(value: npt.ArrayLike, number: int, kinds: str, name: str) -> npt.NDArray[Any]:
    """Return numbers of these dtype kinds as (N,), or (1,) for one that all points share; else raise ValueError."""
    array = np.asarray(value)
    if array.shape not in ((), (number,)) or (array.dtype.kind not in kinds and array.size):
        raise ValueError(f"{name}: expected one value or {number}, got {array.dtype} of shape {array.shape}")
    return np.require(array.reshape(-1), np.bool_ if kinds == "b" else np.float64, ["C", "A", "W"])


def checked_floats(value: npt.ArrayLike, shape: tuple[int, ...], name: str) -> F8:
    """Return finite numbers of this shape as a contiguous float64 copy, else raise ValueError."""
    try:
        array = np.array(value, np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected an array of numbers of shape {shape}") from error
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers")
    return array


def checked_points(points: npt.ArrayLike, name: str) -> npt.NDArray[np.floating]:
    """Return (N, 3) real numbers, else raise ValueError. Native float32 and float64 are not copied."""
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers of shape (N, 3), got {array.dtype} of shape {array.shape}")
    if array.dtype not in (np.float32, np.float64) or not array.dtype.isnative:
        array = array.astype(np.float64)
    return array


def checked_covariances(covariance: npt.ArrayLike | None, number: int, error_model: str) -> F8:
    """Return (N, 3, 3), or (1, 3, 3) for one shared by all points, else raise ValueError. None only for "point"."""
    if covariance is None:
        if error_model != "point":
            raise ValueError(f"covariance: expected (N, 3, 3) or (3, 3) for error_model {error_model!r}, got None")
        return np.zeros((1, 3, 3))
    array = np.asarray(covariance)
    if array.shape not in ((number, 3, 3), (3, 3)) or array.dtype.kind not in "fiu":
        raise ValueError(
            f"covariance: expected numbers of shape ({number}, 3, 3) or (3, 3), got {array.dtype} of {array.shape}"
        )
    return np.require(array.reshape(-1, 3, 3), np.float64, ["C", "A", "W"])
