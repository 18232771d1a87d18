"""The layers computed from a cell's own record, and the names of all layers."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from math import inf, isfinite

import numpy as np

from roughmap.arrays import F8, Flags, Records
from roughmap.reading.error_function import erf

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
"""Layers computed from the cell's own record."""

NEIGHBOUR_LAYERS = ("gradient_x", "gradient_y", "slope", "step_height", "traversability")
"""Layers that also need the cells around, across tile borders."""

LAYERS = CELL_LAYERS + NEIGHBOUR_LAYERS
"""All layers. `roughmap_schemas.layers.LAYERS` repeats them for clients that do not load the core."""

SINGLE_POINT = 1.0 + 1e-6
"""Up to this expected number of points a cell has no spread: W - W2/W would be a rounding error."""

ZERO_WHERE_UNKNOWN = frozenset({"count", "weight"})
"""Layers that are 0 instead of NaN in an unknown cell."""


def check_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return ``names`` as a tuple. ValueError names an unknown layer and the known ones."""
    checked = (names,) if isinstance(names, str) else tuple(names)
    for name in checked:
        if name not in LAYERS:
            raise ValueError(f"unknown layer {name!r}; expected {', '.join(LAYERS)}")
    return checked


def check_tolerance(height_tolerance: float) -> float:
    """Return ``height_tolerance`` as a float. ValueError unless it is a positive, finite number of metres."""
    tolerance = float(height_tolerance)
    if not (isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"height_tolerance is {height_tolerance}; expected a positive, finite number of metres")
    return tolerance


def unknown_plane(name: str, shape: tuple[int, ...]) -> F8:
    """Return a layer of unknown cells: NaN, but 0 for ``count`` and ``weight``."""
    return np.full(shape, 0.0 if name in ZERO_WHERE_UNKNOWN else np.nan)


def cell_layers(records: Records, names: Iterable[str], height_tolerance: float, newest_updated: int) -> dict[str, F8]:
    """Return the layers ``names``, all of ``CELL_LAYERS``, in this order, as float64 in the shape of ``records``.

    ``records``: of ``CELL_DTYPE``, of any level. Units are metres and seconds; unknown values are NaN.
    ``height_tolerance``: full width d of the interval of ``confidence_level`` (eq. 11). ``newest_updated``: newest
    `updated` of the map, from which ``age`` is counted. KeyError for a name that is not in ``CELL_LAYERS``.
    """
    state = _Cells(records, height_tolerance, newest_updated)
    return {name: _FORMULAS[name](state) for name in names}


class _Cells:
    """Records and the quantities that several layers share, each computed once, on first use."""

    def __init__(self, records: Records, height_tolerance: float, newest_updated: int) -> None:
        self.records = records
        self.height_tolerance = height_tolerance
        self.newest_updated = newest_updated

    @cached_property
    def unknown(self) -> Flags:
        unknown: Flags = self.records["count"] == 0
        return unknown

    def known(self, values: F8) -> F8:
        """Return a copy of ``values`` with NaN in unknown cells."""
        return np.where(self.unknown, np.nan, values)

    @cached_property
    def expected_count(self) -> F8:
        """n = W^2 / W2."""
        weight = self.records["weight"]
        with np.errstate(invalid="ignore"):
            return self.known(weight * weight / self.records["weight_sq"])

    @cached_property
    def std_dev(self) -> F8:
        """Eq. 6 for weights: sqrt(m2 / (W - W2/W)); NaN where the expected number of points is at most one."""
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
        """Seconds from the cell's `updated` to the newest of the map."""
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
"""The limits of ``traversability``, in radians, metres, metres, metres, and as a probability."""

DEFAULT_LIMITS = {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9}

GroundLimits = tuple[float, float, float, float, float]
"""One limit for each of ``LIMIT_NAMES``; inf if it is not used."""


def check_limits(limits: Mapping[str, float] | None) -> GroundLimits:
    """Return the limits in the order of ``LIMIT_NAMES``; None stands for ``DEFAULT_LIMITS``.

    ValueError for an unknown name, for a limit that is not positive and finite, and for an empty mapping, which would
    rate all ground as safe.
    """
    given = DEFAULT_LIMITS if limits is None else dict(limits)
    if not given:
        raise ValueError(f"limits are empty; expected one or more of {', '.join(LIMIT_NAMES)}")
    for name, limit in given.items():
        if name not in LIMIT_NAMES:
            raise ValueError(f"unknown limit {name!r}; expected {', '.join(LIMIT_NAMES)}")
        if not (isfinite(limit) and limit > 0.0):
            raise ValueError(f"limit {name} is {limit}; expected a positive, finite number")
    slope, step, std_dev, extent, confidence = (float(given.get(name, inf)) for name in LIMIT_NAMES)
    return slope, step, std_dev, extent, confidence
