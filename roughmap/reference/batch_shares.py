"""The cells that the points of a batch touch, and their shares (eq. 12, 14), in numpy over pairs of point and cell."""

from dataclasses import dataclass

import numpy as np

from roughmap.arrays import F8, I8, Flags

INT32 = np.iinfo(np.int32)

LEAST_SHARE = 1e-12
"""Shares up to this are rounding errors and do not count, for any ``min_share``."""

CHUNK_PAIRS = 1 << 16
"""Pairs per batch of ellipse areas, each of which needs about 50 temporary numbers."""


@dataclass(frozen=True)
class Pairs:
    """Points and the cells that they touch, in ascending order of the points; all arrays are (P,)."""

    point: I8
    i: I8
    j: I8
    share: F8
    """p, the share of the error body that lies in the cell."""
    density: F8
    """q = w / p of the point; its weight in the cell is p q."""


def cells_of_points(points: F8, cell_size: float) -> tuple[Pairs, Flags]:
    """Return the cells of (N, 3) points, and for which points the cell numbers fit 32 bits."""
    i, j = _cell_numbers(points[:, 0], cell_size), _cell_numbers(points[:, 1], cell_size)
    inside = _fits(i) & _fits(j)
    point = np.flatnonzero(inside)
    one = np.ones(len(point))
    return Pairs(point, i[inside].astype(np.int64), j[inside].astype(np.int64), one, one), inside


def cells_of_bodies(
    points: F8, radius: F8, correlation: F8 | None, density: F8, cell_size: float, min_share: float
) -> tuple[Pairs, Flags]:
    """Return the cells that the error bodies of (N, 3) points touch, and for which bodies the cell numbers fit 32 bits.

    ``radius``: (N, 2), half extents along x and y. The body is a rectangle, or an ellipse if ``correlation``, (N,), is
    given. ``density``: q, (N,). A cell counts if its share is at least ``min_share`` times the point's largest share.
    """
    low = _cell_numbers(points[:, :2] - radius, cell_size)
    high = _cell_numbers(points[:, :2] + radius, cell_size)
    inside: Flags = np.logical_and.reduce(_fits(low) & _fits(high), axis=1)
    kept = np.flatnonzero(inside)
    first = low[kept].astype(np.int64)
    across, up = (high[kept].astype(np.int64) - first + 1).T
    number = across * up
    starts = np.cumsum(number) - number
    row = np.repeat(np.arange(len(kept)), number)
    place = np.arange(len(row)) - starts[row]
    i = first[row, 0] + place % across[row]
    j = first[row, 1] + place // across[row]
    point = kept[row]
    # Cell borders relative to the centre of the body, in radii: exact differences even far from the origin.
    left, right, bottom, top = (
        (edge * cell_size - points[point, axis]) / radius[point, axis]
        for axis, edge in ((0, i), (0, i + 1), (1, j), (1, j + 1))
    )
    if correlation is None:
        share = _clipped(left, right) * _clipped(bottom, top) / 4.0
    else:
        share = np.empty(len(point))
        for begin in range(0, len(point), CHUNK_PAIRS):
            part = slice(begin, begin + CHUNK_PAIRS)
            rho = correlation[point[part]]
            share[part] = _ellipse_shares(left[part], right[part], bottom[part], top[part], rho)
    largest = np.maximum.reduceat(share, starts)[row] if len(row) else share
    chosen = (share >= min_share * largest) & (share > LEAST_SHARE)
    point = point[chosen]
    return Pairs(point, i[chosen], j[chosen], share[chosen], density[point]), inside


def _cell_numbers(metres: F8, cell_size: float) -> F8:
    """Return cell numbers as floats, which can be checked before they are converted."""
    with np.errstate(over="ignore"):
        return np.floor(metres / cell_size)


def _fits(numbers: F8) -> Flags:
    inside: Flags = (numbers >= INT32.min) & (numbers <= INT32.max)
    return inside


def _clipped(low: F8, high: F8) -> F8:
    """Return the length of [low, high] inside [-1, 1]."""
    length: F8 = np.clip(high, -1.0, 1.0) - np.clip(low, -1.0, 1.0)
    return length


def _ellipse_shares(left: F8, right: F8, bottom: F8, top: F8, rho: F8) -> F8:
    """Return the exact shares of ellipses in rectangles, computed in strips.

    In units of its radii the ellipse is rho u - beta sqrt(1 - u^2) <= v <= rho u + beta sqrt(1 - u^2) with beta^2 = 1 -
    rho^2, and its area is pi beta. Its two arcs cross v = V at u = rho V +- beta sqrt(1 - V^2). Between two
    neighbouring crossings each arc stays below, in or above the rectangle, and its integral has a closed form.
    """
    beta = np.sqrt((1.0 - rho) * (1.0 + rho))
    first, last = np.clip(left, -1.0, 1.0), np.clip(right, -1.0, 1.0)
    cuts = [first, last]
    for level in (bottom, top):
        half = beta * np.sqrt(np.clip(1.0 - level * level, 0.0, None))
        cuts += [np.clip(rho * level + sign * half, first, last) for sign in (-1.0, 1.0)]
    strips = np.sort(np.stack(cuts), axis=0)
    begin, end = strips[:-1], strips[1:]
    width = end - begin
    middle = 0.5 * (begin + end)
    straight = 0.5 * rho * (begin + end) * width
    curved = beta * (_arc_integral(end) - _arc_integral(begin))
    rise = beta * np.sqrt((1.0 - middle) * (1.0 + middle))

    def bounded(arc: F8, integral: F8) -> F8:
        return np.where(arc >= top, top * width, np.where(arc <= bottom, bottom * width, integral))

    upper = bounded(rho * middle + rise, straight + curved)
    lower = bounded(rho * middle - rise, straight - curved)
    share: F8 = np.clip(upper - lower, 0.0, None).sum(axis=0) / (np.pi * beta)
    return share


def _arc_integral(u: F8) -> F8:
    """Return the integral of sqrt(1 - u^2)."""
    integral: F8 = 0.5 * (u * np.sqrt((1.0 - u) * (1.0 + u)) + np.arcsin(u))
    return integral
