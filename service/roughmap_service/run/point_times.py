"""Which form the times of a sensor's points have: found in its first clouds, or refused as ambiguous.

Pure functions of what was logged. A form fits if, in its unit, the values span 1 ms to 1 s and not much more than the
time from one cloud to the next, and lie where its origin says.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from roughmap_schemas import NO_TIMES, Cloud, TimeField, TimeForm
from roughmap_schemas.geometry import SECOND_NS
from roughmap_schemas.point_times import BEYOND_NS, UNIT_NS, Origin, Unit, relative_ns, sample

Auto = Literal["auto"]

NAMES: Final = ("t", "time", "timestamp", "offset_time", "time_stamp", "ts")
"""Fields that "auto" looks at. If several say the same, it takes the first of these."""

ENOUGH: Final = 5
"""Clouds of two points or more that bring a decision."""

SHORTEST_S: Final = 0.001
LONGEST_S: Final = 1.0
LONGEST_ALONE_S: Final = 0.5
"""Limits on the time from the first point to the last; `LONGEST_ALONE_S` where one cloud decides."""

PERIODS: Final = 1.5
"""Limit on the same, in median distances of stamps."""

WHOLE: Final = 0.3
"""From this many distances on it is a whole sweep, and not a few neighbouring points read in too large a unit."""

FASTEST: Final = 2e7
"""More points a second than any scanner measures."""

SURE_S: Final = 0.01
"""From here on the next larger unit makes no sense, not even for a driver's mistake."""

STEPS: Final = 20
"""Least number of different values that the type can hold between the first and the last."""

NEAR_S: Final = 5.0
"""How far from the stamp absolute times may be."""

CORE: Final = 0.7
"""Share of a cloud's values that must make sense; the others may be anything."""

AGREED_S: Final = 0.001
"""Two forms that give the same times but for this may both be right."""

FIRING: Final = 512
"""More points than a scanner measures at the same moment."""

SHARES: Final = "looks like shares of a sweep, not times"
"""What is said of values from 0 to 1, which no unit makes times of."""

LARGEST: Final = 1e20
"""No time is larger, in any unit."""

BEYOND_S: Final = BEYOND_NS / SECOND_NS

Fields = tuple[int, Sequence[TimeField]]
"""A cloud's stamp in ns and its fields."""


@dataclass(frozen=True, slots=True)
class Ambiguous:
    """No form fits, or several do. ``seen`` says what was seen, in one line."""

    seen: str


class _Fit(NamedTuple):
    """A form that fits, and the times of the first and last point that it gives, in s after the stamp (medians)."""

    form: TimeForm
    first: float
    last: float


def find_form(
    clouds: Sequence[Fields],
    field: str = "auto",
    unit: Unit | Auto = "auto",
    origin: Origin | Auto = "auto",
    *,
    last: bool = False,
) -> TimeForm | Ambiguous | None:
    """Return the form of a sensor's times, as found in its first ``clouds``; None if more clouds are needed.

    ``field``, ``unit`` and ``origin`` are the sensor's settings. One cloud is enough if a single form fits and the span
    is at most 0.5 s; else `ENOUGH` clouds of two points or more decide, or fewer with ``last``.
    """
    if field == "none":
        return NO_TIMES
    if field != "auto" and unit != "auto" and origin != "auto":
        return TimeForm(field, unit, origin)
    names = NAMES if field == "auto" else (field,)
    having = [cloud for cloud in clouds if any(f.name in names for f in cloud[1])]
    if clouds and not having:
        return NO_TIMES if field == "auto" else Ambiguous(f"no field {field}, but {_names(clouds[0][1])}")
    having = [(stamp, fields) for stamp, fields in having if len(fields[0].values) > 1][:ENOUGH]
    done = last or len(having) == ENOUGH
    if not done and len(having) != 1:
        return None
    period = _period([stamp for stamp, _ in having])
    columns = [column for name in names if (column := _Column.of(name, having, period)) is not None]
    if not columns:  # all values are equal
        return NO_TIMES if done or len(having[0][1][0].values) > FIRING else None
    fits = [fit for column in columns for fit in column.fits(unit, origin, last=done)]
    if fits and all(abs(f.first - fits[0].first) < AGREED_S and abs(f.last - fits[0].last) < AGREED_S for f in fits):
        return fits[0].form
    if not done:
        return None
    apart = "" if period is None else f", clouds {period:.3g} s apart"
    fit = "fits " + (" or ".join(f"{f.form.field} in {f.form.unit} ({f.form.origin})" for f in fits) or "no form")
    if not fits and all(column.shares for column in columns):
        fit = SHARES
    return Ambiguous(f"{'; '.join(column.text for column in columns)}{apart}: {fit}")


def misfit(cloud: Cloud, form: TimeForm) -> bool:
    """Tell whether a cloud's times seem to have another form than was found.

    That is, most of its points would have no valid time, or all would have nearly the same.
    """
    if not len(cloud.points):
        return False
    if not form.field:
        return any(not math.isnan(_range(f.values)[0]) for f in cloud.time_fields if f.name in NAMES)
    values = cloud.time_values(form.field)
    if values is None:
        return True
    times, first, last = relative_ns(sample(values), cloud.stamp_ns, form)
    good = times[(times >= first) & (times <= last)]
    if 2 * len(good) < len(times):
        return True
    return len(values) > FIRING and len(values) * SECOND_NS > FASTEST * (int(good.max()) - int(good.min()))


@dataclass(frozen=True, slots=True)
class _Column:
    """A field over several clouds: its type, and medians of what was seen, in its own unit."""

    name: str
    dtype: np.dtype[Any]
    low: float
    high: float
    span: float
    largest: float
    number: float
    """Points of a cloud."""
    lateness: tuple[tuple[float, float, float], ...]
    """Stamp in s, first and last value of each cloud."""
    period: float | None

    @classmethod
    def of(cls, name: str, clouds: Sequence[Fields], period: float | None) -> Self | None:
        """Look at a field; None if its values are all equal, or it is not there, in half of the clouds."""
        columns = [(stamp, f.values) for stamp, fields in clouds for f in fields if f.name == name]
        seen = [(stamp / SECOND_NS, len(v), *_range(v)) for stamp, v in columns]
        seen = [(stamp, number, low, high) for stamp, number, low, high in seen if not math.isnan(low)]
        if 2 * len(seen) <= len(columns):
            return None
        return cls(
            name=name,
            dtype=columns[0][1].dtype,
            low=median(low for _, _, low, _ in seen),
            high=median(high for _, _, _, high in seen),
            span=median(high - low for _, _, low, high in seen),
            largest=max(max(abs(low), abs(high)) for _, _, low, high in seen),
            number=median(number for _, number, _, _ in seen),
            lateness=tuple((stamp, low, high) for stamp, _, low, high in seen),
            period=period,
        )

    @property
    def text(self) -> str:
        """The field and its values, for a log line."""
        return f"{self.name} ({self.dtype.name}) from {self.low:.10g} to {self.high:.10g}"

    @property
    def shares(self) -> bool:
        """Whether the values seem to count from 0 to 1 in each sweep, in no unit."""
        return self.dtype.kind == "f" and self.low >= 0.0 and 0.9 < self.largest < 1.05

    def fits(self, unit: Unit | Auto, origin: Origin | Auto, *, last: bool) -> Iterator[_Fit]:
        """Yield the forms that fit; with ``last``, no more clouds will tell more."""
        longest = LONGEST_S if last else LONGEST_ALONE_S
        if self.period is not None:
            longest = min(LONGEST_S, PERIODS * self.period)
        for u, ns in UNIT_NS.items():
            scale = ns / SECOND_NS
            span = self.span * scale
            if unit not in ("auto", u) or not span <= longest or (unit == "auto" and not self._may_be(span)):
                continue
            if origin in ("auto", "absolute"):
                after = [(low * scale - stamp, high * scale - stamp) for stamp, low, high in self.lateness]
                begin, end = median(low for low, _ in after), median(high for _, high in after)
                if origin == "absolute" or max(-begin, end) <= NEAR_S:
                    yield _Fit(TimeForm(self.name, u, "absolute"), begin, end)
            if origin != "absolute" and (unit != "auto" or self._may_be_in(u, span, last=last)):
                yield from self._relative(u, self.low * scale, self.high * scale, longest, origin)

    def _relative(self, unit: Unit, first: float, last: float, longest: float, origin: Origin | Auto) -> Iterator[_Fit]:
        """Yield "start" or "end" for values from ``first`` to ``last``, in s, if they begin or end near 0."""
        if self.period is None:
            longest = min(longest, 1.1 * (last - first) + 0.002)
        early = last < -first if origin == "auto" else origin == "end"
        if not early and first >= -BEYOND_S and last <= longest:
            yield _Fit(TimeForm(self.name, unit, "start"), first, last)
        elif early and -longest <= first and last <= BEYOND_S:
            yield _Fit(TimeForm(self.name, unit, "end"), first, last)
        elif early and first >= 0.0 and last <= longest:
            yield _Fit(TimeForm(self.name, unit, "end"), first - last, 0.0)

    def _may_be(self, span: float) -> bool:
        """Tell whether values of this type can be times of a sweep of ``span`` s."""
        whole = self.dtype.kind in "ui"
        step = 1.0 if whole else float(np.spacing(np.array(self.largest, self.dtype)))
        return span >= SHORTEST_S and self.dtype.itemsize >= 4 and self.span >= STEPS * step and not self.shares

    def _may_be_in(self, unit: Unit, span: float, *, last: bool) -> bool:
        """Tell whether it is a sweep in this unit, neither a few points in a smaller nor nonsense in a larger one."""
        if self.name == "t" and unit == "ns" and self.dtype == np.uint32:
            return True  # by the contract
        if self.name == "t" and unit == "s" and self.dtype.kind == "f" and (last or self.period is not None):
            return True  # likewise
        if self.period is not None and span >= WHOLE * self.period:
            return True
        if span < SURE_S:
            return False
        smaller = max((ns for ns in UNIT_NS.values() if ns < UNIT_NS[unit]), default=0)
        return self.number * SECOND_NS > FASTEST * self.span * smaller


def _range(values: npt.NDArray[Any]) -> tuple[float, float]:
    """Return the first and last value without strays, NaN if all are equal.

    That is the shortest interval of `CORE` of (a sample of) the values, and as much again on either side. If so many
    are the same, that one marks points without a return, and the others count.
    """
    taken = sample(values).astype(np.float64)
    numbers = np.sort(taken[np.abs(taken) < LARGEST])  # false for NaN
    for _ in range(2):
        most = max(math.ceil(CORE * len(numbers)), 2)
        if len(numbers) < most:
            break
        widths = numbers[most - 1 :] - numbers[: len(numbers) - most + 1]
        at = int(widths.argmin())
        width = float(widths[at])
        if width > 0.0:
            near = numbers[(numbers >= numbers[at] - width) & (numbers <= numbers[at + most - 1] + width)]
            return float(near[0]), float(near[-1])
        numbers = numbers[numbers != numbers[at]]
    return math.nan, math.nan


def _period(stamps: Sequence[int]) -> float | None:
    """Return the median distance of neighbouring stamps in s; None if there are no two different ones."""
    apart = [abs(b - a) for a, b in pairwise(stamps) if a != b]
    return median(apart) / SECOND_NS if apart else None


def _names(fields: Sequence[TimeField]) -> str:
    return ", ".join(f.name[:20] for f in fields[:10]) or "none beside x, y and z"
