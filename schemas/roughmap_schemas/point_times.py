"""The points' own times: from a cloud's raw field to nanoseconds.

A form says which field holds them and how its values are read (`TimeForm`); ``timed`` applies it. Which form a sensor's
clouds have is the service's decision, told by the event `sensor_time`.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from roughmap_schemas.geometry import SECOND_NS

if TYPE_CHECKING:
    from roughmap_schemas.cloud import Cloud

Unit = Literal["s", "ms", "us", "ns"]
Origin = Literal["start", "end", "absolute"]

UNIT_NS: Final[dict[Unit, int]] = {"s": SECOND_NS, "ms": 1_000_000, "us": 1_000, "ns": 1}

BAD_OFFSET: Final = -1
"""Marks an invalid time of a point. The map rejects such points as `time`."""

LONGEST_NS: Final = SECOND_NS
"""The longest time from a cloud's first point to its last, and from its stamp to a point."""

BEYOND_NS: Final = SECOND_NS // 10
"""How far points may lie on the other side of the stamp: before it with origin "start", after it with "end"."""

STAMP_LIMIT_NS: Final = (1 << 32) * SECOND_NS

SAMPLED: Final = 512
GOLDEN: Final = 0.6180339887498949
FAR_NS: Final = 1e15
"""Larger differences, in ns, are only known to be far off: they may not fit an integer."""


@dataclass(frozen=True, slots=True, eq=False)
class TimeField:
    """A scalar field of a cloud: ``values`` (N,) of a numeric type, usually a view of the payload, unaligned."""

    name: str
    values: NDArray[Any]


@dataclass(frozen=True, slots=True)
class TimeForm:
    """How the times of a cloud's points are read: their field (``""``: none), the unit of its values, their origin.

    "start": a point's time is the cloud's stamp plus its value. "end": likewise, with negative values; if most are
    positive, the latest point lies at the stamp. "absolute": the value is the time since the Unix epoch.
    """

    field: str
    unit: Unit
    origin: Origin


NO_TIMES: Final = TimeForm("", "ns", "start")
"""All points lie at the stamp."""


def timed(cloud: "Cloud", form: TimeForm, offset_ns: int = 0) -> "Cloud":
    """Return the cloud with the times of its points, without its raw fields.

    ``stamp_ns`` becomes the time of the earliest valid point, ``offsets_ns`` (N,) int64 the times after it.
    ``offset_ns`` is added to all. A point is invalid (`BAD_OFFSET`) if its time is not finite; more than 1 s after the
    stamp ("start"), before it ("end") or from the median ("absolute"); more than 0.1 s on the other side of the stamp;
    or more than 1 s after the earliest. A cloud that lacks the field has no valid point. Exact to the nanosecond, or as
    far as the field's type goes.
    """
    base_ns = cloud.stamp_ns + offset_ns
    offsets = None
    if form.field:
        values = cloud.time_values(form.field)
        if values is None:
            offsets = np.full(len(cloud.points), BAD_OFFSET, np.int64)
        else:
            base_ns, offsets = _from_earliest(base_ns, *relative_ns(values, cloud.stamp_ns, form))
    return replace(cloud, stamp_ns=min(max(base_ns, 0), STAMP_LIMIT_NS - 1), offsets_ns=offsets, time_fields=())


def contract_timed(cloud: "Cloud") -> "Cloud":
    """Return the cloud with its times as in logs of rules 1: field `t` alone, UINT32 in ns or floats in s.

    ``stamp_ns`` stays. Times that are negative, over 1 s or not finite are invalid.
    """
    values = cloud.time_values("t")
    offsets = None
    if values is not None and values.dtype.kind == "u":
        offsets = values.astype(np.int64)
        offsets[offsets > LONGEST_NS] = BAD_OFFSET
    elif values is not None:
        seconds = values.astype(np.float64)
        with np.errstate(invalid="ignore"):
            good = (seconds >= 0.0) & (seconds <= 1.0)  # false for NaN
        offsets = np.where(good, np.rint(np.where(good, seconds, 0.0) * 1e9), BAD_OFFSET).astype(np.int64)
    return replace(cloud, offsets_ns=offsets, time_fields=())


def sample(values: NDArray[Any], most: int = SAMPLED) -> NDArray[Any]:
    """Return ``values``, or ``most`` of them from places that no regular pattern favours, the same ones each time."""
    return values if len(values) <= most else values[_places(len(values), most)]


@lru_cache(maxsize=4)
def _places(number: int, most: int) -> NDArray[np.int64]:
    # Weyl's sequence: a stride would meet only bad values if, say, each fifth one is bad.
    return (np.arange(1, most + 1) * GOLDEN % 1.0 * number).astype(np.int64)


def relative_ns(values: NDArray[Any], stamp_ns: int, form: TimeForm) -> tuple[NDArray[np.int64], int, int]:
    """Return the times (N,) in ns after ``stamp_ns``, and the first and last of them that is valid.

    Those that are not finite, or years off, lie outside that window.
    """
    unit_ns = UNIT_NS[form.unit]
    since = stamp_ns if form.origin == "absolute" else 0
    if values.dtype.kind in "ui":
        times = values.astype(np.int64)
        if unit_ns != 1:
            times *= unit_ns
        if since:
            times -= since
    else:
        times = _of_floats(values, since, unit_ns)
    if form.origin == "start":
        return times, -BEYOND_NS, LONGEST_NS
    if form.origin == "absolute":
        middle = _middle(times, int(FAR_NS) // 2)
        return times, middle - LONGEST_NS, middle + LONGEST_NS
    if _middle(times, LONGEST_NS) > 0:
        times -= times[np.abs(times) <= LONGEST_NS].max()
    return times, -LONGEST_NS, BEYOND_NS


def _of_floats(values: NDArray[np.floating[Any]], since_ns: int, unit_ns: int) -> NDArray[np.int64]:
    """Return floats in ns after ``since_ns``; `FAR_NS` where they are not finite or farther than that."""
    numbers = values.astype(np.float64)
    rest_ns = 0
    if since_ns:
        # The difference of near numbers is exact; what the stamp has beyond a float is subtracted as an integer.
        near = float(since_ns // unit_ns)
        numbers -= near
        rest_ns = since_ns - int(near) * unit_ns
    with np.errstate(over="ignore", invalid="ignore"):
        numbers *= float(unit_ns)
        if not (len(numbers) == 0 or (numbers.min() > -FAR_NS and numbers.max() < FAR_NS)):  # true for NaN
            numbers[~(np.abs(numbers) < FAR_NS)] = FAR_NS
    times = np.rint(numbers, out=numbers).astype(np.int64)
    if rest_ns:
        times -= rest_ns
    return times


def _middle(times: NDArray[np.int64], within: int) -> int:
    """Return the median of (a sample of) the times that are at most ``within`` from 0; 0 if there are none."""
    near = sample(times)
    near = near[np.abs(near) <= within]
    return int(np.median(near)) if len(near) else 0


def _from_earliest(base_ns: int, times: NDArray[np.int64], first: int, last: int) -> tuple[int, NDArray[np.int64]]:
    """Turn times after ``base_ns``, valid from ``first`` to ``last``, to the earliest's and those after it."""
    first, last = max(first, -base_ns), min(last, STAMP_LIMIT_NS - 1 - base_ns)
    if not len(times):
        return base_ns, times
    earliest, latest = int(times.min()), int(times.max())
    good = None
    if earliest < first or latest > last:
        good = (times >= first) & (times <= last)
        if not good.any():
            return base_ns, np.full(len(times), BAD_OFFSET, np.int64)
        earliest = int(times[good].min())
    if earliest:
        times -= earliest
    if good is not None:
        times[~good] = BAD_OFFSET
    if latest - earliest > LONGEST_NS:
        times[times > LONGEST_NS] = BAD_OFFSET
    return base_ns + earliest, times
