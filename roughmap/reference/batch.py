"""Dividing and calculating: all points are divided among the cells, then each cell is computed in two passes.

It builds the same map as ``RoughMap``, but from all points at once, in plain numpy and with independent arithmetic. The
running update is compared with it in results and in speed.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from math import ceil, floor
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from roughmap.arrays import F8, I8, Flags
from roughmap.cell import STAMP_LIMIT_NS, PointReason
from roughmap.points.bodies import HEIGHT_MAX
from roughmap.points.checks import checked_points
from roughmap.reading.layers import LIMIT_NAMES, PAPER_LAYERS, SINGLE_POINT, check_limits, check_tolerance
from roughmap.reference.batch_shares import Pairs, cells_of_bodies, cells_of_points
from roughmap.reference.error_function import erf

T = TypeVar("T", bound=np.generic)

PSD_SLACK = 1e-9
"""How far below zero an eigenvalue may lie, as a fraction of the trace: a covariance may be rounded."""

BOUND_SLACK = 1e-6
"""In cells; keeps a bound such as 0.3 / 0.1 = 2.9999999999999996 on its cell border, as in `region`."""


class BatchMap(Mapping[str, F8]):
    """The cells of a complete set of points, and each layer over them by name: (M,) float64, NaN where unknown.

    ``points``: (N, 3) in the map frame, metres. ``covariance``: (N, 3, 3), or (3, 3) for all points, m^2; required
    unless ``error_model`` is "point". ``stamp_ns``: a scalar or (N,). The other settings are those of ``RoughMap``, the
    last two those of ``RoughMap.region``. ValueError for wrong shapes, a missing covariance, a stamp outside
    [0, 2^32 s) or unknown names. Each layer is an array over the cells instead of a rectangle:

        W = sum w,  W2 = sum w^2 / p,  mean = sum w h / W (eq. 2, 13),  m2 = sum w (h - mean)^2 (eq. 6, 14),
        inv_cf = sum w / max(|h - mean at that point|, min_distance)^2 (eq. 15, 16), from cumulative sums

    Attributes:
        cells: (M, 2) int64, the known cells (i, j), ascending.
        accepted: number of points used.
        rejected: numbers of points not used, by reason.
    """

    def __init__(
        self,
        points: npt.ArrayLike,
        covariance: npt.ArrayLike | None = None,
        stamp_ns: npt.ArrayLike = 0,
        *,
        cell_size: float = 0.1,
        error_model: str = "cuboid",
        coverage: float = 2.0,
        min_radius: float = 1e-3,
        min_distance: float = 1e-3,
        min_share: float = 0.05,
        max_horizontal_radius: float = 0.5,
        max_vertical_sigma: float = 0.5,
        bounds: tuple[float, float, float, float] | None = None,
        height_tolerance: float = 0.05,
        limits: Mapping[str, float] | None = None,
    ) -> None:
        if error_model not in {"point", "cuboid", "ellipsoid"}:
            raise ValueError(f"error_model is {error_model!r}; expected point, cuboid or ellipsoid")
        self._side = float(cell_size)
        self._tolerance = check_tolerance(height_tolerance)
        self._limits = dict(zip(LIMIT_NAMES["all"], check_limits(limits), strict=True))
        where, stamps = _checked_points(points, stamp_ns)
        reason = np.zeros(len(where), dtype=np.uint8)
        _reject(reason, ~np.isfinite(where).all(axis=1), PointReason.NOT_FINITE)
        S = None
        if error_model != "point":
            S = _checked_covariances(covariance, len(where))
            _reject(reason, ~_is_covariance(S), PointReason.COVARIANCE)
            spread = np.sqrt(np.clip(np.maximum(S[:, 0, 0], S[:, 1, 1]), 0.0, None))
            too_wide = (coverage * spread > max_horizontal_radius) | (
                S[:, 2, 2] > max_vertical_sigma * max_vertical_sigma
            )
            _reject(reason, too_wide, PointReason.UNCERTAIN)
        _reject(reason, abs(where[:, 2]) > HEIGHT_MAX, PointReason.BOUNDS)
        if bounds is not None:
            x, y = where[:, 0], where[:, 1]
            inside = (x >= bounds[0]) & (x < bounds[2]) & (y >= bounds[1]) & (y < bounds[3])
            _reject(reason, ~inside, PointReason.BOUNDS)
        good = np.flatnonzero(reason == PointReason.KEPT)
        if S is None:
            pairs, numbered = cells_of_points(where[good], self._side)
        else:
            body = _error_bodies(S[good], error_model, coverage, min_radius, self._side)
            pairs, numbered = cells_of_bodies(where[good], *body, self._side, min_share)
        reason[good[~numbered]] = PointReason.BOUNDS
        self.accepted = int(np.count_nonzero(reason == PointReason.KEPT))
        numbers = np.bincount(reason, minlength=len(PointReason))
        self.rejected = {kind.name.lower(): int(numbers[kind]) for kind in PointReason if kind and numbers[kind]}
        if bounds is not None:
            pairs = _within(pairs, bounds, self._side)
        self._calculate(pairs, where[good, 2], stamps[good], min_distance)

    def _calculate(self, pairs: Pairs, height: F8, stamp_ns: I8, min_distance: float) -> None:
        """Compute the state of each cell from its pairs, in the order of the points."""
        order = np.lexsort((pairs.point, pairs.j, pairs.i))
        i, j, point = pairs.i[order], pairs.j[order], pairs.point[order]
        begins = np.ones(len(order), dtype=bool)
        begins[1:] = (i[1:] != i[:-1]) | (j[1:] != j[:-1])
        first = np.flatnonzero(begins)
        cell = np.cumsum(begins) - 1
        self.cells: I8 = np.column_stack((i[first], j[first]))

        h = height[point]
        q = pairs.density[order]
        w = pairs.share[order] * q
        start = h[first]
        above = h - start[cell]  # differences keep their digits at large altitudes
        self._count = np.diff(np.append(first, len(order)))
        self._updated = _reduce(np.maximum, stamp_ns[point] // 1_000_000_000, first)
        self._weight = _reduce(np.add, w, first)
        self._weight_sq = _reduce(np.add, w * q, first)
        self._mean = start + _reduce(np.add, w * above, first) / self._weight
        self._m2 = _reduce(np.add, w * (h - self._mean[cell]) ** 2, first)
        self._min = _reduce(np.minimum, h, first)
        self._max = _reduce(np.maximum, h, first)
        place = np.arange(len(order)) - first[cell]
        mean_then = _cumulative(w * above, place) / _cumulative(w, place)
        distance = np.maximum(np.abs(above - mean_then), min_distance)
        self._inv_cf = _reduce(np.add, w / distance**2, first)

    def __getitem__(self, name: str) -> F8:
        return _FORMULAS[name](self).astype(np.float64)

    def __iter__(self) -> Iterator[str]:
        return iter(PAPER_LAYERS)

    def __len__(self) -> int:
        return len(PAPER_LAYERS)

    @cached_property
    def _expected_count(self) -> F8:
        n: F8 = self._weight**2 / self._weight_sq
        return n

    @cached_property
    def _std_dev(self) -> F8:
        """Eq. 6 with weights."""
        several = (self._count >= 2) & (self._expected_count > SINGLE_POINT)
        freedom = np.where(several, self._weight - self._weight_sq / self._weight, np.nan)
        spread: F8 = np.sqrt(self._m2 / freedom)
        return spread

    def _confidence_level(self) -> F8:
        """Eq. 11, with the expected number of points for n."""
        with np.errstate(divide="ignore"):
            x = self._tolerance * np.sqrt(self._expected_count) / (2.0 * self._std_dev)
        return erf(x / np.sqrt(2.0))

    def _age(self) -> F8:
        return float(self._updated.max(initial=0)) - self._updated.astype(np.float64)

    def _mean_beside(self, across: int, up: int) -> F8:
        """Return the mean height of a neighbour of each cell, NaN where there is none."""
        sought = self.cells + np.array([across, up])
        place = np.searchsorted(_packed(self.cells), _packed(sought))
        place = np.clip(place, 0, max(len(self.cells) - 1, 0))
        return np.where((self.cells[place] == sought).all(axis=1), self._mean[place], np.nan)

    def _gradient(self, across: int, up: int) -> F8:
        before, after = self._mean_beside(-across, -up), self._mean_beside(across, up)
        both = (after - before) / (2.0 * self._side)
        one = np.where(np.isnan(before), after - self._mean, self._mean - before) / self._side
        return np.where(np.isnan(both), one, both)

    def _slope(self) -> F8:
        angle: F8 = np.arctan(np.hypot(self._gradient(1, 0), self._gradient(0, 1)))
        return angle

    def _step_height(self) -> F8:
        around = [(across, up) for across in (-1, 0, 1) for up in (-1, 0, 1) if across or up]
        steps = [np.abs(self._mean_beside(across, up) - self._mean) for across, up in around]
        highest: F8 = np.fmax.reduce(steps)
        return highest

    def _traversability(self) -> F8:
        """Return the least of the terms: 0 if any term is 0, else NaN if any term is NaN."""
        layers = dict(
            zip(LIMIT_NAMES["all"], ("slope", "step_height", "std_dev", "range", "confidence_level"), strict=True)
        )
        terms = []
        for name, limit in self._limits.items():
            if np.isfinite(limit):
                part = self[layers[name]] / limit
                terms.append(np.clip(part if name == "confidence" else 1.0 - part, 0.0, 1.0))
        stacked = np.stack(terms)
        return np.where((stacked == 0.0).any(axis=0), 0.0, stacked.min(axis=0))


_FORMULAS: dict[str, Callable[[BatchMap], npt.NDArray[np.generic]]] = {
    "mean_height": lambda b: b._mean,
    "mid_range_height": lambda b: (b._max + b._min) / 2.0,
    "max_height": lambda b: b._max,
    "min_height": lambda b: b._min,
    "std_dev": lambda b: b._std_dev,
    "range": lambda b: b._max - b._min,
    "confidence_level": BatchMap._confidence_level,
    "confidence_factor": lambda b: 1.0 / b._inv_cf,
    "mean_variance": lambda b: b._std_dev**2 / b._expected_count,
    "count": lambda b: b._count,
    "weight": lambda b: b._weight,
    "expected_count": lambda b: b._expected_count,
    "age": BatchMap._age,
    "gradient_x": lambda b: b._gradient(1, 0),
    "gradient_y": lambda b: b._gradient(0, 1),
    "slope": BatchMap._slope,
    "step_height": BatchMap._step_height,
    "traversability": BatchMap._traversability,
}


def _packed(cells: I8) -> I8:
    """Pack (M, 2) cell numbers into one each, in the same order. Wraps beyond 32 bits, where no neighbour exists."""
    return (cells[:, 0] << 32) + cells[:, 1]


def _checked_points(points: npt.ArrayLike, stamp_ns: npt.ArrayLike) -> tuple[F8, I8]:
    where = checked_points(points, "points").astype(np.float64)
    stamps = np.asarray(stamp_ns)
    if not np.issubdtype(stamps.dtype, np.integer) or stamps.shape not in {(), (len(where),)}:
        raise ValueError(f"stamps are {stamps.dtype} {stamps.shape}; expected an integer or ({len(where)},) integers")
    if stamps.size and (int(stamps.min()) < 0 or int(stamps.max()) >= STAMP_LIMIT_NS):
        raise ValueError(f"a stamp is out of range; expected [0, {STAMP_LIMIT_NS}) ns")
    return where, np.broadcast_to(stamps.astype(np.int64), (len(where),))


def _checked_covariances(covariance: npt.ArrayLike | None, number: int) -> F8:
    """Return symmetric (N, 3, 3) covariances, taken from the upper triangles."""
    if covariance is None:
        raise ValueError("no covariance; expected (N, 3, 3) or (3, 3) unless error_model is point")
    given = np.asarray(covariance, dtype=np.float64)
    if given.shape not in {(3, 3), (number, 3, 3)}:
        raise ValueError(f"covariance has the shape {given.shape}; expected ({number}, 3, 3) or (3, 3)")
    upper = np.broadcast_to(np.triu(given), (number, 3, 3))
    return upper + np.triu(upper, 1).swapaxes(1, 2)


def _is_covariance(S: F8) -> Flags:
    """Whether each matrix is finite, with no negative diagonal entry and no eigenvalue below -1e-9 times the trace."""
    good: Flags = np.logical_and.reduce(np.isfinite(S), axis=(1, 2))
    good &= np.logical_and.reduce(np.diagonal(S, axis1=1, axis2=2) >= 0.0, axis=1)
    matrices = S[good]
    good[good] = np.linalg.eigvalsh(matrices)[:, 0] >= -PSD_SLACK * np.trace(matrices, axis1=1, axis2=2)
    return good


def _error_bodies(
    S: F8, error_model: str, coverage: float, min_radius: float, cell_side: float
) -> tuple[F8, F8 | None, F8]:
    """Return half extents along x and y (N, 2), their correlation (ellipsoids only, else None), and q (eq. 14)."""
    if error_model == "cuboid":
        radius = np.maximum(coverage * np.sqrt(np.diagonal(S, axis1=1, axis2=2)), min_radius)
        return radius[:, :2], None, cell_side / radius.prod(axis=1)
    least = (min_radius / coverage) ** 2
    values, axes = np.linalg.eigh(S)
    raised = (axes * np.maximum(values, least)[:, None, :]) @ axes.swapaxes(1, 2)
    solid = np.where((values[:, 0] < least)[:, None, None], raised, S)
    sigma = np.sqrt(np.stack((solid[:, 0, 0], solid[:, 1, 1]), axis=1))
    volume = coverage**3 * np.sqrt(np.maximum(values, least).prod(axis=1))
    return coverage * sigma, solid[:, 0, 1] / sigma.prod(axis=1), cell_side / volume


def _reject(reason: npt.NDArray[np.uint8], bad: Flags | np.bool_, kind: PointReason) -> None:
    """Set the reason of the ``bad`` points, except for those already rejected."""
    reason[bad & (reason == PointReason.KEPT)] = kind


def _within(pairs: Pairs, bounds: tuple[float, float, float, float], side: float) -> Pairs:
    """Return the pairs whose cells lie in the bounds of the map."""
    i0, j0 = (floor(value / side + BOUND_SLACK) for value in bounds[:2])
    i1, j1 = (ceil(value / side - BOUND_SLACK) for value in bounds[2:])
    kept = (pairs.i >= i0) & (pairs.i < i1) & (pairs.j >= j0) & (pairs.j < j1)
    return Pairs(pairs.point[kept], pairs.i[kept], pairs.j[kept], pairs.share[kept], pairs.density[kept])


def _reduce(how: np.ufunc, values: npt.NDArray[T], first: I8) -> npt.NDArray[T]:
    """Reduce the values of each cell by ``how``; ``first``: the position of the first value of each cell."""
    reduced: npt.NDArray[T] = how.reduceat(values, first)
    return reduced


def _cumulative(values: F8, place: I8) -> F8:
    """Return cumulative sums that restart in each cell; ``place``: the position of each value in its cell.

    By doubling: after the step of length s each value is the sum of the last 2s values of its cell. Differences of one
    running total would lose digits where a heavy cell precedes a light one.
    """
    sums = values.copy()
    step = 1
    while step <= place.max(initial=0):
        before = np.where(place >= step, np.roll(sums, step), 0.0)
        sums = sums + before
        step *= 2
    return sums
