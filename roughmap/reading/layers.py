"""The names of all layers, and the checks of what a caller asks for."""

from collections.abc import Iterable, Mapping
from math import inf, isfinite

import numpy as np

from roughmap.arrays import F8

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
