"""What a cell says: the layers that follow from its own record, and the names of all."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from math import inf, isfinite

import numpy as np

from roughmap.arrays import F8, Flags, Records
from roughmap.reading.normal import erf

CELL_LAYERS = (
    "mean_height",
    "mid_range_height",
    "max_height",
    "min_height",
    "std_dev",
    "range",
    "confidence_level",
    "confidence_factor",
    "mean_variance",
    "count",
    "weight",
    "expected_count",
    "age",
)
"""The layers for which a cell's own record is enough."""

NEIGHBOUR_LAYERS = ("gradient_x", "gradient_y", "slope", "step_height", "traversability")
"""The layers that look at the cells around, across tile borders too."""

LAYERS = CELL_LAYERS + NEIGHBOUR_LAYERS

SINGLE_POINT = 1.0 + 1e-6
"""Up to this expected number of points a cell has no spread to speak of: W - W2/W would be rounding."""

ZERO_WHERE_UNKNOWN = frozenset({"count", "weight"})
"""The layers that are 0, and not NaN, in a cell that no point has touched."""


def check_names(names: Iterable[str]) -> tuple[str, ...]:
    """``names`` as a tuple, or ValueError that names the unknown one and the known ones."""
    checked = (names,) if isinstance(names, str) else tuple(names)
    for name in checked:
        if name not in LAYERS:
            raise ValueError(f"unknown layer {name!r}; expected some of {', '.join(LAYERS)}")
    return checked


def check_tolerance(height_tolerance: float) -> float:
    """``height_tolerance`` as a float, or ValueError: a positive, finite number of metres."""
    tolerance = float(height_tolerance)
    if not (isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"height_tolerance is {height_tolerance}; expected a positive, finite number of metres")
    return tolerance


def unknown_plane(name: str, shape: tuple[int, ...]) -> F8:
    """A layer of cells that no point has touched: NaN, but 0 for ``count`` and ``weight``."""
    return np.full(shape, 0.0 if name in ZERO_WHERE_UNKNOWN else np.nan)


def cell_layers(records: Records, names: Iterable[str], height_tolerance: float, newest_updated: int) -> dict[str, F8]:
    """The asked ones of ``CELL_LAYERS``, in the asked order, float64 in the shape of ``records``.

    ``records`` are of ``CELL_DTYPE``, of any level; metres and seconds; NaN where not known. ``height_tolerance`` is
    the full width d of ``confidence_level`` (eq. 11), ``newest_updated`` the map's newest `updated`, from which ``age``
    counts back. KeyError for a name that is not of ``CELL_LAYERS``.
    """
    state = _Cells(records, height_tolerance, newest_updated)
    return {name: _FORMULAS[name](state) for name in names}


class _Cells:
    """The columns of some records and what several layers share, each computed when it is first asked for."""

    def __init__(self, records: Records, height_tolerance: float, newest_updated: int) -> None:
        self.records = records
        self.height_tolerance = height_tolerance
        self.newest_updated = newest_updated

    @cached_property
    def unknown(self) -> Flags:
        unknown: Flags = self.records["count"] == 0
        return unknown

    def known(self, values: F8) -> F8:
        """A fresh plane of ``values``, NaN in unknown cells."""
        return np.where(self.unknown, np.nan, values)

    @cached_property
    def expected_count(self) -> F8:
        """n = W^2 / W2."""
        weight = self.records["weight"]
        with np.errstate(invalid="ignore"):
            return self.known(weight * weight / self.records["weight_sq"])

    @cached_property
    def std_dev(self) -> F8:
        """Eq. 6 for weights: sqrt(m2 / (W - W2/W)); NaN where there is no more than one point to speak of."""
        weight = self.records["weight"]
        with np.errstate(invalid="ignore", divide="ignore"):
            spread = np.sqrt(self.records["m2"] / (weight - self.records["weight_sq"] / weight))
            return np.where((self.records["count"] >= 2) & (self.expected_count > SINGLE_POINT), spread, np.nan)

    def confidence_level(self) -> F8:
        """Eq. 11: 2F(x) - 1 = erf(x / sqrt 2) with x = d sqrt(n) / (2 std_dev); erf(inf) = 1 where std_dev is 0."""
        with np.errstate(divide="ignore", over="ignore"):
            half_widths = self.height_tolerance * np.sqrt(self.expected_count) / (2.0 * self.std_dev)
        return erf(half_widths / np.sqrt(2.0))

    def confidence_factor(self) -> F8:
        """Eq. 15, 16: 1 / inv_cf."""
        with np.errstate(divide="ignore"):
            return self.known(1.0 / self.records["inv_cf"])

    def age(self) -> F8:
        """Seconds from a cell's `updated` to the map's newest."""
        return self.known(float(self.newest_updated) - self.records["updated"])


_FORMULAS = {
    "mean_height": lambda cells: cells.known(cells.records["mean"]),
    "mid_range_height": lambda cells: cells.known(0.5 * (cells.records["max"] + cells.records["min"])),
    "max_height": lambda cells: cells.known(cells.records["max"]),
    "min_height": lambda cells: cells.known(cells.records["min"]),
    "std_dev": lambda cells: cells.std_dev,
    "range": lambda cells: cells.known(cells.records["max"] - cells.records["min"]),
    "confidence_level": _Cells.confidence_level,
    "confidence_factor": _Cells.confidence_factor,
    "mean_variance": lambda cells: cells.std_dev**2 / cells.expected_count,
    "count": lambda cells: cells.records["count"].astype(np.float64),
    "weight": lambda cells: cells.records["weight"].astype(np.float64),
    "expected_count": lambda cells: cells.expected_count,
    "age": _Cells.age,
}


LIMIT_NAMES = ("slope", "step", "std_dev", "range", "confidence")
"""What ``traversability`` can be bounded by: radians, metres, metres, metres, and a probability."""

DEFAULT_LIMITS = {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9}

GroundLimits = tuple[float, float, float, float, float]
"""One limit for each of ``LIMIT_NAMES``, inf for one that is not used."""


def check_limits(limits: Mapping[str, float] | None) -> GroundLimits:
    """The limits in the order of ``LIMIT_NAMES``; None stands for ``DEFAULT_LIMITS``.

    ValueError for an unknown name, for a limit that is not positive and finite, and for no limit at all: the least of
    nothing would call all ground safe.
    """
    given = DEFAULT_LIMITS if limits is None else dict(limits)
    if not given:
        raise ValueError(f"limits are empty; expected one or more of {', '.join(LIMIT_NAMES)}")
    for name, limit in given.items():
        if name not in LIMIT_NAMES:
            raise ValueError(f"unknown limit {name!r}; expected some of {', '.join(LIMIT_NAMES)}")
        if not (isfinite(limit) and limit > 0.0):
            raise ValueError(f"limit {name} is {limit}; expected a positive, finite number")
    slope, step, std_dev, extent, confidence = (float(given.get(name, inf)) for name in LIMIT_NAMES)
    return slope, step, std_dev, extent, confidence
