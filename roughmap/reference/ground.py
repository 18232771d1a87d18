"""A ground map in dictionaries, point by point and cell by cell: the oracle of ``surface="ground"``.

It is slow and plain. Error bodies of the `point` and `cuboid` models are computed here; the ellipse's areas come from
`roughmap.points`, because other formulas agree only to about 1e-11 (`BatchMap` judges those).
"""

import math
from typing import Any, NamedTuple

import numpy as np

from roughmap.arrays import F8
from roughmap.cell import TILE_SHIFT
from roughmap.points.ellipse import corner_share, ellipse_shares, half_chord, half_plane, pivots, raise_eigenvalues
from roughmap.points.poly import angle
from roughmap.reference.ground_cell import CellRules, GroundCell, Hit
from roughmap.settings import MapSettings

LEAST_SHARE = 1e-12
"""Shares up to this are rounding errors of the cell edges and do not count."""

HEIGHT_MAX = 1e7
"""Metres. Higher and lower points are out of bounds."""

INT_MIN, INT_MAX = -(1 << 31), (1 << 31) - 1

Cells = dict[tuple[int, int], GroundCell]
"""Known cells by (i, j)."""


class Body(NamedTuple):
    """An error body: half extents along x and y, correlation and sqrt(1 - its square), and q = w / share (eq. 14)."""

    ex: float
    ey: float
    rho: float
    beta: float
    q: float


class GroundOracle:
    """A map of the ground, cell by cell.

    ``settings``: as of the map, whose state this predicts to the byte. ``cells`` has the known cells.
    """

    def __init__(self, settings: MapSettings) -> None:
        self.settings = settings
        self.cells: Cells = {}

    def add(
        self,
        points: F8,
        covariance: F8 | None = None,
        stamp_ns: Any = 0,
        *,
        common: Any = 0.0,
        mount: Any = 0.0,
        up: Any = False,
        pose_error_time: float = 5.0,
    ) -> int:
        """Add (N, 3) points in the map frame, one by one; return how many were used.

        ``covariance``: (N, 3, 3), or (3, 3) for all, positive semidefinite; not looked at by the `point` model.
        ``stamp_ns``, ``common`` and ``mount`` (variances, m^2) and ``up``: scalars or (N,).
        """
        number = len(points)
        matrices = np.broadcast_to(np.zeros((3, 3)) if covariance is None else covariance, (number, 3, 3))
        values = [np.broadcast_to(value, (number,)).tolist() for value in (stamp_ns, common, mount, up)]
        rules = CellRules(self.settings.cell_size, self.settings.min_distance, pose_error_time)
        used = 0
        for point, S, stamp, c, m, steep in zip(points.tolist(), matrices, *values, strict=True):
            x, y, h = point
            body = self._body(S)
            if body is None or not self._is_inside(x, y, h, body):
                continue
            used += 1
            for i, j, share, main in self._shares(x, y, body):
                hit = Hit(h, share * body.q, body.q, int(stamp), c, m, bool(steep), main)
                if (i, j) in self.cells or not hit.up:
                    self.cells.setdefault((i, j), GroundCell()).add(hit, rules)
        return used

    def records(self) -> dict[tuple[int, int], tuple[Any, Any, Any]]:
        """Return the cell, trust and column of each known cell, as (1,) arrays of the types that tiles hold."""
        return {place: cell.records() for place, cell in self.cells.items()}

    def _body(self, S: F8) -> Body | None:
        """Return the error body of a point, None if it is too uncertain."""
        if self.settings.error_model == "point":
            return Body(0.0, 0.0, 0.0, 1.0, 1.0)
        k, least, widest, tallest = self.settings.error
        xx, xy, xz, yy, yz, zz = (float(S[r, c]) for r, c in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
        if k * math.sqrt(max(xx, yy)) > widest or zz > tallest * tallest:
            return None
        if self.settings.error_model == "cuboid":
            rx, ry, rz = (max(k * math.sqrt(value), least) for value in (xx, yy, zz))
            return Body(rx, ry, 0.0, 1.0, self.settings.cell_size / (rx * ry * rz))
        floor = (least / k) * (least / k)
        if min(pivots(xx - floor, xy, xz, yy - floor, yz, zz - floor)) > 0.0:
            d0, d1, d2 = pivots(xx, xy, xz, yy, yz, zz)
            det = d0 * d1 * d2
        else:
            planes = np.array([[xx], [xy], [xz], [yy], [yz], [zz]])
            det = raise_eigenvalues(planes, 0, 0, floor)
            xx, xy, _, yy = (float(value) for value in planes[:4, 0])
        product = xx * yy
        rho, beta = xy / math.sqrt(product), math.sqrt(max(product - xy * xy, 0.0) / product)
        q = self.settings.cell_size / (k * k * k * math.sqrt(det))
        return Body(k * math.sqrt(xx), k * math.sqrt(yy), rho, beta, q)

    def _is_inside(self, x: float, y: float, h: float, body: Body) -> bool:
        """Whether a point is finite, in the map's bounds, and touches only cells that have numbers."""
        if not (math.isfinite(x) and math.isfinite(y) and abs(h) <= HEIGHT_MAX):
            return False
        xmin, ymin, xmax, ymax = self.settings.area
        i0, j0, i1, j1 = self._box(x, y, body)
        return xmin <= x < xmax and ymin <= y < ymax and min(i0, j0) >= INT_MIN and max(i1, j1) <= INT_MAX

    def _box(self, x: float, y: float, body: Body) -> tuple[int, int, int, int]:
        """Return the first and last cells along x and y that an error body covers: i0, j0, i1, j1."""
        a = self.settings.cell_size
        low, high = (x - body.ex) / a, (x + body.ex) / a
        south, north = (y - body.ey) / a, (y + body.ey) / a
        return math.floor(low), math.floor(south), math.floor(high), math.floor(north)

    def _shares(self, x: float, y: float, body: Body) -> list[tuple[int, int, float, bool]]:
        """Return the cells that a point is counted in: i, j, share (eq. 12), and whether it is the largest share."""
        i0, j0, i1, j1 = self._box(x, y, body)
        places = [(i, j) for j in range(j0, j1 + 1) for i in range(i0, i1 + 1)]
        if len(places) == 1:
            shares = [1.0]
        elif self.settings.error_model == "cuboid":
            across = [_overlap(i, x, body.ex, self.settings.cell_size) for i in range(i0, i1 + 1)]
            shares = [_overlap(j, y, body.ey, self.settings.cell_size) * p for j in range(j0, j1 + 1) for p in across]
        else:
            shares = self._ellipse(x, y, body, (i0, j0, i1, j1))
        if max(shares) <= LEAST_SHARE:
            # The error body is finer than float64's spacing here: it counts for the cell of the point alone.
            a = self.settings.cell_size
            own = min(max(math.floor(x / a), i0), i1), min(max(math.floor(y / a), j0), j1)
            shares = [float(place == own) for place in places]
        largest = max(shares)
        main = shares.index(largest)
        w0, v0, w1, v1 = self.settings.window
        return [
            (i, j, p, n == main)
            for n, ((i, j), p) in enumerate(zip(places, shares, strict=True))
            if p >= self.settings.min_share * largest and p > LEAST_SHARE and w0 <= i <= w1 and v0 <= j <= v1
        ]

    def _ellipse(self, x: float, y: float, body: Body, box: tuple[int, int, int, int]) -> list[float]:
        """Return the shares of an ellipse, row by row: at most 2 x 2 cells of one tile have a formula of their own."""
        i0, j0, i1, j1 = box
        w0, v0, w1, v1 = self.settings.window
        one_tile = i0 >> TILE_SHIFT == i1 >> TILE_SHIFT and j0 >> TILE_SHIFT == j1 >> TILE_SHIFT
        small = i1 - i0 <= 1 and j1 - j0 <= 1 and one_tile and i0 >= w0 and j0 >= v0 and i1 <= w1 and j1 <= v1
        if small:
            four = _four_shares(x, y, body, box, self.settings.cell_size)
            if max(four) > LEAST_SHARE:
                return [four[2 * (j - j0) + i - i0] for j in range(j0, j1 + 1) for i in range(i0, i1 + 1)]
        ni, nj = i1 - i0 + 1, j1 - j0 + 1
        lines, shares = np.empty((5, ni + 1)), np.empty(ni * nj)
        ellipse_shares(
            x, y, body.ex, body.ey, body.rho, body.beta, i0, j0, ni, nj, self.settings.cell_size, lines, shares
        )
        return [float(p) for p in shares]


def _overlap(n: int, centre: float, radius: float, a: float) -> float:
    """Return the part of [centre - radius, centre + radius] in cell ``n`` along an axis."""
    low = min(max(n * a - centre, -radius), radius)
    high = min(max((n + 1) * a - centre, -radius), radius)
    return max(high - low, 0.0) / (2.0 * radius)


def _four_shares(x: float, y: float, body: Body, box: tuple[int, int, int, int], a: float) -> list[float]:
    """Return the shares of an ellipse in the four cells around the middle of its box, row by row."""
    i0, j0, i1, j1 = box
    U = 1.0 if i0 == i1 else ((i0 + 1.0) * a - x) / body.ex
    V = 1.0 if j0 == j1 else ((j0 + 1.0) * a - y) / body.ey
    su, sv = half_chord(U), half_chord(V)
    au, av = angle(U, su), angle(V, sv)
    left, below = half_plane(U, su, au), half_plane(V, sv, av)
    arc = angle(body.rho, body.beta)
    both = corner_share(U, su, au, left, V, sv, av, below, body.rho, body.beta, arc)
    rest = (1.0 - left) - (below - both)
    return [max(p, 0.0) for p in (both, below - both, left - both, rest)]
