"""What makes coordinates in the map frame doubtful: no data, degrees instead of metres, too few digits."""

import numpy as np
import numpy.typing as npt

from roughmap_service.formats.recorded import Floats, PlacedPoints

NO_DATA = (-999.0, -9999.0, -99999.0, -999999.0, -32767.0, -32768.0)
"""Heights that stand for "no data" in grids and their exports."""

NO_DATA_SIZE = 1e30
"""So do coordinates of at least this size, such as GDAL's -3.4e38."""

SAMPLE = 10_000
"""Coordinates that doubts are decided on: the first ones of a file."""

LEAST = 20
"""With fewer coordinates there is no doubt: chance makes them look like anything."""


def no_data(points: Floats) -> npt.NDArray[np.bool_]:
    """Return which of the points (N, 3) are placeholders."""
    z = points[:, 2]
    found = np.asarray((np.abs(points) >= NO_DATA_SIZE).any(axis=1) & np.isfinite(points).all(axis=1))
    # Few heights are below -900 m; the comparison by value is for them alone.
    low = z < NO_DATA[0] + 1
    if low.any():
        found |= np.isin(z, NO_DATA)
    return found


def without_no_data(part: PlacedPoints) -> PlacedPoints:
    """Return the part without placeholders."""
    kept = ~no_data(part.points)
    if kept.all():
        return part
    stamps = part.stamp_ns if isinstance(part.stamp_ns, int) else part.stamp_ns[kept]
    covariance = part.covariance
    if covariance is not None and covariance.ndim == 3:
        covariance = covariance[kept]
    return PlacedPoints(part.points[kept], stamps, covariance)


class Doubts:
    """Collects the first coordinates of a file and says what is doubtful about them."""

    def __init__(self) -> None:
        self._parts: list[Floats] = []
        self._count = 0

    def take(self, places: Floats) -> None:
        """Take more places (N, 3) in the map frame, metres: points, or poses."""
        more = places[: max(SAMPLE - self._count, 0)]
        if len(more):
            self._parts.append(more.copy())
            self._count += len(more)

    def found(self, cell_size: float) -> list[str]:
        """Return the doubts, one sentence each; `cell_size` is the map's, in metres."""
        places = np.concatenate([np.empty((0, 3)), *self._parts])
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            return []
        return [text for text in (_degrees(places), _coarse(places, cell_size)) if text is not None]


def _degrees(places: Floats) -> str | None:
    """Say so if x and y are within a globe's degrees, far from 0, and z varies ten times as much as they do.

    On the ground a degree is 100 km: what is hills in metres is a flagpole when degrees are taken for metres.
    """
    low, high = places.min(axis=0), places.max(axis=0)
    wide = float((high - low)[:2].max())
    away = float(np.abs((high + low) / 2)[:2].max())
    globe = bool((np.abs(places[:, :2]) <= (180, 90)).all())
    if len(places) < 3 or not globe or away < max(1.0, 2 * wide) or high[2] - low[2] < max(0.1, 10 * wide):
        return None
    return (
        f"this looks like degrees: x from {low[0]:.6f} to {high[0]:.6f}, y from {low[1]:.6f} to {high[1]:.6f}; "
        "the map takes metres: project the coordinates, for example to UTM"
    )


def _coarse(places: Floats, cell_size: float) -> str | None:
    """Say so if x or y have only the values of a float32 whose steps are above a quarter of a cell.

    Of a regular grid, odd and even multiples of the step don't both occur, unless that is its own step.
    """
    steps = []
    for name, values in (("x", places[:, 0]), ("y", places[:, 1])):
        largest = float(np.abs(values).max())
        step = float(np.spacing(np.float32(min(largest, 1e30))))
        odd = np.mod(values, 2 * step) != 0
        stored = len(values) >= LEAST and bool(np.all(values == values.astype(np.float32)))
        if stored and step > cell_size / 4 and odd.any() and not odd.all():
            steps.append(f"{name} of {step:g} m")
    if not steps:
        return None
    return (
        f"steps in {' and in '.join(steps)} are too coarse for cells of {cell_size:g} m: float32 holds no more digits "
        "this far from 0; save float64, or subtract an origin first"
    )
