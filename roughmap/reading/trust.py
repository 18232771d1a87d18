"""How far a cell's mean height may be wrong: from the scatter of its points, and from errors that they share.

The scatter says how rough the ground is; its mean is the surer the more points there are. Errors of pose and mounting
are alike for all points of a scan, so that no number of points averages them out: they come from the cell's trust. A
cell of few points borrows roughness from the tile that it lies in.
"""

from collections.abc import Iterable
from math import inf, nan, sqrt

import numpy as np

from roughmap.arrays import F4, F8, I8, U8, Records, Scalar
from roughmap.jit import inline, kernel
from roughmap.reading.cell_values import LOW_HALF, M2_AT, WEIGHT_AT, WEIGHT_SQ_AT, as_words
from roughmap.reading.functions import student_95, student_within
from roughmap.reading.layers import TRUST_LAYERS

MEAN_SIGMA, INTERVAL_95, CONFIDENCE, LOCAL_CONFIDENCE = range(len(TRUST_LAYERS))

_NUMBERS = {name: number for number, name in enumerate(TRUST_LAYERS)}

VARIANCE_AT, POSE_VARIANCE_AT, MOUNT_SIGMA_AT = 0, 2, 3
"""Words of a record of ``TRUST_DTYPE``."""

POINTS, FREE, SHARED, SCATTER, BORDER, COMMON, SUMMARY = range(7)
"""Rows of a summary of cells: see `_summarise`."""

FIRST_PRIOR = 0.03 * 0.03, 2.0
"""Variance of the ground's heights within a cell that is assumed before any is known, and how many degrees of freedom
that assumption counts for."""

TILE_FREEDOM = 4.0
"""Degrees of freedom that the tile's own roughness counts for, and that a cell must have to take part in it."""

TILE_QUORUM = 20
"""Cells that must take part."""

SMOOTHEST = 0.005 * 0.005
"""Least variance that a tile's roughness is taken for."""

NEIGHBOURS_PART = 0.05
"""Part of the ground's variance that does not average out in a cell whose points all lie on its borders."""


@kernel
def _summarise(heads: U8, words: F8, trust: F4, out: F8) -> None:
    """Fill ``out`` (SUMMARY, N) with what the read-out needs of each cell.

    POINTS: (n + count) / 2, the number of points that the mean's variance goes with; -1 for an unknown cell. FREE: one
    less, at least 0. SCATTER: FREE times the sample variance. SHARED: the part of SCATTER that changing errors of the
    poses explain. BORDER: the part of the variance that stays. COMMON: variance of the errors that all points share.
    """
    for c in range(len(heads)):
        count = np.float64(heads[c, 0] & LOW_HALF)
        weight = words[c, WEIGHT_AT]
        expected = weight * weight / words[c, WEIGHT_SQ_AT]
        points = 0.5 * (expected + count)
        more = np.float64(trust[c, POSE_VARIANCE_AT]) - np.float64(trust[c, VARIANCE_AT])
        mount = np.float64(trust[c, MOUNT_SIGMA_AT])
        whole = expected / count
        known = count > 0.0
        out[POINTS, c] = points if known else -1.0
        out[FREE, c] = points - 1.0 if points > 1.0 else 0.0
        out[SHARED, c] = points * (0.0 if more < 0.0 else more) if known else 0.0
        out[SCATTER, c] = points * (words[c, M2_AT] / weight) if known else 0.0
        out[BORDER, c] = NEIGHBOURS_PART * (0.0 if whole > 1.0 else 1.0 - whole)
        out[COMMON, c] = np.float64(trust[c, VARIANCE_AT]) + mount * mount


@inline
def _freedom(free: float, shared: float, prior: float) -> Scalar:
    """Return how much a cell's own scatter counts for: the less of it, the more of the scatter the poses explain."""
    rough = prior / (prior + shared / free)
    return rough * rough if free > 0.0 else 0.0


@kernel
def _estimates(summary: F8, out: F8) -> int:
    """Write the roughness variances of the cells that have enough points to ``out``; return their number."""
    prior = FIRST_PRIOR[0]
    for c in range(len(out)):
        free, shared = summary[FREE, c], summary[SHARED, c]
        enough = _freedom(free, shared, prior) * free >= TILE_FREEDOM
        out[c] = (summary[SCATTER, c] - shared) / free if enough else nan
    number = 0
    for c in range(len(out)):
        out[number] = out[c]
        number += out[c] == out[c]
    return number


@inline
def _own(summary: F8, c: Scalar, prior: float, prior_freedom: float) -> Scalar:
    """Return the variance of a cell's mean from its own scatter, and its degrees of freedom."""
    free, shared, points = summary[FREE, c], summary[SHARED, c], summary[POINTS, c]
    part = _freedom(free, shared, prior)
    freedom = prior_freedom + part * free
    variance = (prior_freedom * prior + part * (summary[SCATTER, c] - shared)) / freedom
    least = 0.1 * prior
    variance = least if variance < least else variance
    return variance * (1.0 / points + summary[BORDER, c]), freedom


@kernel
def _read(summary: F8, numbers: I8, prior: float, prior_freedom: float, tolerance: float, out: F8) -> None:
    """Fill ``out`` (L, N) with the layers ``numbers``. Sums that are not finite say nothing: any error is possible."""
    half = 0.5 * tolerance
    for k in range(len(numbers)):
        layer = numbers[k]
        for c in range(out.shape[1]):
            own, freedom = _own(summary, c, prior, prior_freedom)
            variance = own if layer == LOCAL_CONFIDENCE else own + summary[COMMON, c]
            sigma = sqrt(variance)
            share = variance / own
            freedom = freedom * (share * share)
            if layer == MEAN_SIGMA:
                value, worst = sigma, inf
            elif layer == INTERVAL_95:
                value, worst = student_95(freedom) * sigma, inf
            else:
                value, worst = student_within(half / sigma, freedom), 0.0
            value = worst if value != value else value  # noqa: PLR0124 - NaN
            out[k, c] = nan if summary[POINTS, c] < 0.0 else value


def trust_layers(cells: Records, trust: Records, names: Iterable[str], height_tolerance: float) -> dict[str, F8]:
    """Return the layers ``names``, all of ``TRUST_LAYERS``, of a whole tile, as float64 in the shape of ``cells``.

    ``cells`` of CELL_DTYPE and ``trust`` of TRUST_DTYPE are of the same level. Heights are in metres; unknown cells
    are NaN, known ones never. ``height_tolerance``: full width d; the confidences are the probabilities that the mean
    is wrong by d / 2 at most, by Student's distribution.
    """
    chosen = tuple(names)
    heads, words = as_words(cells)
    flat = np.ascontiguousarray(trust).reshape(-1)
    flat.flags.writeable = False
    summary = np.empty((SUMMARY, cells.size))
    _summarise(heads, words, flat.view(np.float32).reshape(cells.size, -1), summary)
    planes = np.empty((len(chosen), cells.size))
    numbers = np.array([_NUMBERS[name] for name in chosen], np.int64)
    _read(summary, numbers, *_prior(summary), height_tolerance, planes)
    return dict(zip(chosen, planes.reshape(-1, *cells.shape), strict=True))


def _prior(summary: F8) -> tuple[float, float]:
    """Return the roughness that cells of few points borrow, and the degrees of freedom that it counts for.

    It is the lower median over the tile, if enough cells have points enough to tell.
    """
    estimates = np.empty(summary.shape[1])
    number = _estimates(summary, estimates)
    if number < TILE_QUORUM:
        return FIRST_PRIOR
    middle = (number - 1) // 2
    median = float(np.partition(estimates[:number], middle)[middle])
    return max(median, SMOOTHEST), TILE_FREEDOM
