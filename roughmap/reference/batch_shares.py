"""Which cells the points of a batch touch, and with what shares (eq. 12, 14): numpy over pairs of point and cell."""

from dataclasses import dataclass

import numpy as np

from roughmap.arrays import F8, I8, Flags

INT32 = np.iinfo(np.int32)

LEAST_SHARE = 1e-12
"""Shares up to this are rounding, whatever ``min_share`` says."""

CHUNK_PAIRS = 1 << 16
"""Ellipse areas are computed for so many pairs at a time: some 50 temporary numbers a pair."""


@dataclass(frozen=True)
class Pairs:
    """Points and the cells that they touch, ascending by point; all (P,)."""

    point: I8
    i: I8
    j: I8
    share: F8
    """p, the part of the error body that lies in the cell."""
    density: F8
    """q = w / p of the point, so that its weight in the cell is p q."""


def cells_of_points(points: F8, cell_size: float) -> tuple[Pairs, Flags]:
    """The cell in which each of the (N, 3) points lies, and which points lie where cells can be numbered."""
    i, j = _cell_numbers(points[:, 0], cell_size), _cell_numbers(points[:, 1], cell_size)
    inside = _fits(i) & _fits(j)
    point = np.flatnonzero(inside)
    one = np.ones(len(point))
    return Pairs(point, i[inside].astype(np.int64), j[inside].astype(np.int64), one, one), inside


def cells_of_bodies(
    points: F8, radius: F8, correlation: F8 | None, density: F8, cell_size: float, min_share: float
) -> tuple[Pairs, Flags]:
    """The cells that the error bodies of (N, 3) points touch, and which bodies lie where cells can be numbered.

    ``radius`` is (N, 2), half the body's extent along x and y; the body is a rectangle, or with ``correlation``, (N,),
    an ellipse. ``density`` is q, (N,). A cell takes part if its share is at least ``min_share`` of the point's largest.
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
    # Cell borders relative to the body's middle, in radii: exact differences even far from the origin.
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
    """Cell numbers as floats, so that they can be tested before they are converted."""
    with np.errstate(over="ignore"):
        return np.floor(metres / cell_size)


def _fits(numbers: F8) -> Flags:
    inside: Flags = (numbers >= INT32.min) & (numbers <= INT32.max)
    return inside


def _clipped(low: F8, high: F8) -> F8:
    """The length of [low, high] inside [-1, 1]."""
    length: F8 = np.clip(high, -1.0, 1.0) - np.clip(low, -1.0, 1.0)
    return length


def _ellipse_shares(left: F8, right: F8, bottom: F8, top: F8, rho: F8) -> F8:
    """The shares of ellipses in rectangles, exact, by strips.

    In the units of its radii the ellipse is rho u - beta sqrt(1 - u^2) <= v <= rho u + beta sqrt(1 - u^2) with
    beta^2 = 1 - rho^2, its area pi beta. Its two arcs cross v = V at u = rho V +- beta sqrt(1 - V^2): between two
    neighbouring crossings each arc stays below, in or above the rectangle, where its integral is a closed form.
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
    """The integral of sqrt(1 - u^2)."""
    integral: F8 = 0.5 * (u * np.sqrt((1.0 - u) * (1.0 + u)) + np.arcsin(u))
    return integral
