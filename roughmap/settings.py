"""The settings of a map, checked."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from roughmap.points.bodies import GROUND_HEIGHT_MAX, HEIGHT_MAX
from roughmap.points.footprint import ERROR_MODELS

_MAX_SIDE = 512
"""Largest extent of an error body, in cells. Beyond it one point would cost as much as a scan."""

_SLACK = 1e-6
"""In cells; keeps a bound such as 0.3 / 0.1 = 2.9999999999999996 on its cell border, as in `region`."""

_INT_MIN, _INT_MAX = -(1 << 31), (1 << 31) - 1

MAX_LEVELS = 26
"""At level 25 the 2^26 tiles along an axis are reduced to two."""

SURFACES = ("all", "ground")
"""What cells hold: every point, as in the paper; or the ground, with a column for what is above and below it."""


def ground_band(side: float) -> float:
    """Return how far heights of one ground may differ in a cell, or between neighbours, of this side; metres."""
    return max(0.15, 0.6 * side)


Rules = tuple[int, float, tuple[float, ...], tuple[int, ...], tuple[float, ...], float, bool]
"""The settings as the kernels take them: model, cell_size, area with height_max, window, error, min_share,
ground_only."""


@dataclass(frozen=True)
class MapSettings:
    """The settings of a map that decide its cells. ValueError, naming the setting, for values out of range."""

    cell_size: float
    error_model: str
    coverage: float
    min_radius: float
    min_distance: float
    min_share: float
    max_horizontal_radius: float
    max_vertical_sigma: float
    bounds: Sequence[float] | None
    levels: int
    surface: str = "ground"

    def __post_init__(self) -> None:
        for name in ("cell_size", "coverage", "min_radius", "min_distance", "max_horizontal_radius"):
            value = getattr(self, name)
            # Squares and cubes of these must stay well within the range of float64.
            if not _is_number(value) or not 1e-30 <= value <= 1e30:
                raise ValueError(f"{name}: expected a finite number above 0 (1e-30 to 1e30), got {value!r}")
            object.__setattr__(self, name, float(value))
        tallest: Any = self.max_vertical_sigma
        if not _is_number(tallest) or not tallest > 0.0:
            raise ValueError(f"max_vertical_sigma: expected a number above 0, or infinity, got {tallest!r}")
        object.__setattr__(self, "max_vertical_sigma", float(tallest))
        if self.surface not in SURFACES:
            raise ValueError(f"surface: expected one of {', '.join(SURFACES)}, got {self.surface!r}")
        if self.error_model not in ERROR_MODELS:
            raise ValueError(f"error_model: expected one of {', '.join(ERROR_MODELS)}, got {self.error_model!r}")
        if not _is_number(self.min_share) or not 0.0 <= self.min_share <= 1.0:
            raise ValueError(f"min_share: expected a number in [0, 1], got {self.min_share!r}")
        object.__setattr__(self, "min_share", float(self.min_share))
        if 2.0 * max(self.max_horizontal_radius, self.min_radius) / self.cell_size > _MAX_SIDE:
            raise ValueError(
                f"max_horizontal_radius, min_radius: expected at most {_MAX_SIDE / 2:g} cells of {self.cell_size} m,"
                f" got {self.max_horizontal_radius} m and {self.min_radius} m"
            )
        if not isinstance(self.levels, int) or not 1 <= self.levels <= MAX_LEVELS:
            raise ValueError(f"levels: expected an integer in [1, {MAX_LEVELS}], got {self.levels!r}")
        if self.bounds is not None:
            object.__setattr__(self, "bounds", _checked_bounds(self.bounds))

    @property
    def model(self) -> int:
        """Number of the error model."""
        return ERROR_MODELS.index(self.error_model)

    @property
    def ground_only(self) -> bool:
        """Whether cells hold the ground alone."""
        return self.surface == "ground"

    @property
    def band(self) -> float:
        """Metres by which a point may be off the mean height of the ground that it belongs to."""
        return ground_band(self.cell_size)

    @property
    def area(self) -> tuple[float, float, float, float]:
        """The bounds xmin, ymin, xmax, ymax in metres, half-open; infinite if there are none."""
        if self.bounds is None:
            return -math.inf, -math.inf, math.inf, math.inf
        xmin, ymin, xmax, ymax = self.bounds
        return xmin, ymin, xmax, ymax

    @property
    def height_max(self) -> float:
        """Metres. Points that are higher or lower are out of bounds."""
        return GROUND_HEIGHT_MAX if self.ground_only else HEIGHT_MAX

    @property
    def window(self) -> tuple[int, int, int, int]:
        """The cells i0, j0, i1, j1, inclusive, that may be written."""
        if self.bounds is None:
            return _INT_MIN, _INT_MIN, _INT_MAX, _INT_MAX
        low = [math.floor(value / self.cell_size + _SLACK) for value in self.bounds[:2]]
        high = [math.ceil(value / self.cell_size - _SLACK) - 1 for value in self.bounds[2:]]
        return max(low[0], _INT_MIN), max(low[1], _INT_MIN), min(high[0], _INT_MAX), min(high[1], _INT_MAX)

    @property
    def error(self) -> tuple[float, float, float, float]:
        """coverage, min_radius, max_horizontal_radius, max_vertical_sigma."""
        return self.coverage, self.min_radius, self.max_horizontal_radius, self.max_vertical_sigma

    @property
    def rules(self) -> Rules:
        """The settings as the kernels take them."""
        area = *self.area, self.height_max
        return self.model, self.cell_size, area, self.window, self.error, self.min_share, self.ground_only

    @property
    def side(self) -> int:
        """Largest number of cells along an axis in a footprint."""
        # An eigenvalue may be raised by (min_radius / k)^2. Two more cells for the ends and two for rounding.
        return int(2.0 * math.hypot(self.max_horizontal_radius, self.min_radius) / self.cell_size) + 4


def _is_number(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, int | float)


def _checked_bounds(bounds: Sequence[float]) -> tuple[float, ...]:
    wanted = "bounds: expected four finite numbers xmin, ymin, xmax, ymax with xmin < xmax and ymin < ymax"
    try:
        box = tuple(float(value) for value in bounds)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{wanted}, got {bounds!r}") from error
    if len(box) != 4 or not all(math.isfinite(v) for v in box) or box[0] >= box[2] or box[1] >= box[3]:
        raise ValueError(f"{wanted}, got {bounds!r}")
    return box
