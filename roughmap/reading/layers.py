"""The names of all layers, and the checks of what a caller asks for."""

from collections.abc import Iterable, Mapping
from math import inf, isfinite, nan
from typing import NamedTuple

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

TRUST_LAYERS = ("mean_sigma", "interval_95", "confidence", "local_confidence")
"""Layers computed from the cell's own record and its trust, with the roughness of its tile."""

NEIGHBOUR_LAYERS = ("gradient_x", "gradient_y", "slope", "step_height", "traversability")
"""Layers that also need the cells around, across tile borders."""

GROUND_LAYERS = ("roughness", "obstacle", "obstacle_top", "overhang_low", "passable_share")
"""Layers that only a map of the ground has."""

LAYERS = CELL_LAYERS + TRUST_LAYERS + NEIGHBOUR_LAYERS + GROUND_LAYERS
"""All layers. `roughmap_schemas.layers.LAYERS` repeats them for clients that do not load the core."""

PAPER_LAYERS = CELL_LAYERS + NEIGHBOUR_LAYERS
"""Layers of a map of all points that its records decide without their trust."""

SINGLE_POINT = 1.0 + 1e-6
"""Up to this expected number of points a cell has no spread: W - W2/W would be a rounding error."""

ZERO_WHERE_UNKNOWN = frozenset({"count", "weight"})
"""Layers that are 0 instead of NaN in an unknown cell."""


def layers_of(surface: str) -> tuple[str, ...]:
    """Return the layers that a map of this surface, "ground" or "all", has."""
    return LAYERS if surface == "ground" else tuple(name for name in LAYERS if name not in GROUND_LAYERS)


def check_names(names: Iterable[str], surface: str = "ground") -> tuple[str, ...]:
    """Return ``names`` as a tuple. ValueError names a layer that maps of the surface don't have."""
    checked = (names,) if isinstance(names, str) else tuple(names)
    known = layers_of(surface)
    for name in checked:
        if name not in LAYERS:
            raise ValueError(f"unknown layer {name!r}; expected {', '.join(known)}")
        if name not in known:
            raise ValueError(f"no layer {name!r} in a map of all points; it needs the surface 'ground'")
    return checked


def check_tolerance(height_tolerance: float) -> float:
    """Return ``height_tolerance`` as a float. ValueError unless it is a positive, finite number of metres."""
    tolerance = float(height_tolerance)
    if not (isfinite(tolerance) and tolerance > 0.0):
        raise ValueError(f"height_tolerance is {height_tolerance}; expected a positive, finite number of metres")
    return tolerance


def unknown_value(name: str) -> float:
    """Return a layer's value in an unknown cell."""
    return 0.0 if name in ZERO_WHERE_UNKNOWN else nan


LIMIT_NAMES = {
    "ground": ("slope", "step", "roughness", "confidence", "clearance"),
    "all": ("slope", "step", "std_dev", "range", "confidence"),
}
"""The limits of ``traversability`` by the map's surface: slopes in radians, a probability, else metres."""

DEFAULT_LIMITS = {
    "ground": {"slope": 0.5, "step": 0.2, "roughness": 0.1, "confidence": 0.9, "clearance": 2.0},
    "all": {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9},
}

MAX_CLEARANCE = 2.5
"""Metres. Columns end 2.8 m above the ground, or a little higher."""

PaperLimits = tuple[float, float, float, float, float]
"""One limit for each of those of the surface "all"; inf if it is not used."""


class GroundLimits(NamedTuple):
    """The limits of the surface "ground", which are all in use."""

    slope: float
    step: float
    roughness: float
    confidence: float
    clearance: float


def check_limits(limits: Mapping[str, float] | None) -> PaperLimits:
    """Return limits of the surface "all" in the order of their names; None stands for the defaults.

    ValueError for an unknown name, for a limit that is not positive and finite, and for an empty mapping, which would
    rate all ground as safe.
    """
    given = DEFAULT_LIMITS["all"] if limits is None else dict(limits)
    if not given:
        raise ValueError(f"limits are empty; expected one or more of {', '.join(LIMIT_NAMES['all'])}")
    _check_each(given, "all")
    slope, step, std_dev, extent, confidence = (float(given.get(name, inf)) for name in LIMIT_NAMES["all"])
    return slope, step, std_dev, extent, confidence


def check_ground_limits(limits: Mapping[str, float] | None) -> GroundLimits:
    """Return limits of the surface "ground"; those not given have their defaults.

    ValueError for an unknown name, for a limit that is not positive and finite, and for a clearance above
    ``MAX_CLEARANCE``.
    """
    given = DEFAULT_LIMITS["ground"] | dict(limits or {})
    _check_each(given, "ground")
    if given["clearance"] > MAX_CLEARANCE:
        raise ValueError(f"limit clearance is {given['clearance']}; expected at most {MAX_CLEARANCE} m")
    return GroundLimits(*(float(given[name]) for name in LIMIT_NAMES["ground"]))


def _check_each(given: Mapping[str, float], surface: str) -> None:
    known = LIMIT_NAMES[surface]
    for name, limit in given.items():
        if name not in known:
            raise ValueError(f"unknown limit {name!r} in a map of the surface {surface!r}; expected {', '.join(known)}")
        if not (isfinite(limit) and limit > 0.0):
            raise ValueError(f"limit {name} is {limit}; expected a positive, finite number")
