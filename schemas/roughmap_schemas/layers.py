"""The names of layers and limits, as selectors and grids write them."""

from typing import Final, Literal

Surface = Literal["ground", "all"]
"""What the cells of a map hold: the points of the ground alone, or all points."""

DEFAULT_SURFACE: Final[Surface] = "ground"

LAYERS = (
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
    "mean_sigma",
    "interval_95",
    "confidence",
    "local_confidence",
    "gradient_x",
    "gradient_y",
    "slope",
    "step_height",
    "traversability",
    "roughness",
    "obstacle",
    "obstacle_top",
    "overhang_low",
    "passable_share",
)
"""Every layer. ``roughmap.reading.layers`` has the same tuple; it is repeated here so that a client need not load the
kernels."""

GROUND_LAYERS = ("roughness", "obstacle", "obstacle_top", "overhang_low", "passable_share")
"""Those that only a map of the ground has."""

DEFAULT_LAYERS = ("mean_height",)
"""The layers of a query that names none."""

DEFAULT_LIMITS: Final[dict[Surface, dict[str, float]]] = {
    "ground": {"slope": 0.5, "step": 0.2, "roughness": 0.1, "confidence": 0.9, "clearance": 2.0},
    "all": {"slope": 0.5, "step": 0.2, "std_dev": 0.1, "confidence": 0.9},
}
"""The limits of ``traversability`` in a map that sets none."""

LIMIT_NAMES: Final[dict[Surface, tuple[str, ...]]] = {
    "ground": ("slope", "step", "roughness", "confidence", "clearance"),
    "all": ("slope", "step", "std_dev", "range", "confidence"),
}
"""The quantities that ``traversability`` may limit."""

MAX_CLEARANCE: Final = 2.5
"""Metres: what hangs higher is not looked at."""


def layers_of(surface: str) -> tuple[str, ...]:
    """Return the layers that a map of that surface has."""
    return LAYERS if surface == "ground" else tuple(name for name in LAYERS if name not in GROUND_LAYERS)


def default_limits(surface: object) -> dict[str, float]:
    """Return the limits of a map with that setting of its surface (None: the default)."""
    known = DEFAULT_SURFACE if surface is None else surface
    return DEFAULT_LIMITS["ground" if known == "ground" else "all"]


def fault_of_limit(name: str, value: float, surface: Surface) -> str | None:
    """Return what is wrong with a limit in a map of that surface; None if nothing is."""
    known = LIMIT_NAMES[surface]
    if name not in known:
        other = next((kind for kind, names in LIMIT_NAMES.items() if name in names), None)
        if other is None:
            return f"{name!r} must be one of {', '.join(known)}"
        return (
            f"{name!r} is a limit of maps whose surface is {other!r}; this one's is {surface!r}, with the limits "
            f"{', '.join(known)}"
        )
    if name == "clearance" and value > MAX_CLEARANCE:
        return f"clearance must be at most {MAX_CLEARANCE:g} m"
    return None
