"""Comparison of a map built point by point with the batch method's, cell by cell."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from roughmap.map import RoughMap
from roughmap.reading.layers import PAPER_LAYERS
from roughmap.reference.batch import BatchMap

EXACT = ("max_height", "min_height", "range", "mid_range_height", "count", "age")
"""Layers that agree to the bit: each is one of the heights, or one difference or sum of the same two numbers."""


def compare(m: RoughMap, b: BatchMap, height: float, **options: object) -> None:
    """Compare all layers of both. ``height``: the largest |h|, which determines the rounding of means.

    The mean and the running mean are off by about 1e-16 of the height per point; d = |h - mean| is at least
    min_distance = 1e-3, so that 1/d^2 is off by 2e3 times that. Shares and determinants are exact to about 1e-11: both
    methods compute them from the same S, whose condition is below 1e5.
    """
    if len(b.cells) == 0:
        assert m.tile_count == 0
        return
    got, known = over_cells(m, b.cells, PAPER_LAYERS, **options)
    assert known == len(b.cells)
    for name in EXACT:
        np.testing.assert_array_equal(got[name], b[name], err_msg=name)
    off = 1e-13 * max(height, 1.0)
    np.testing.assert_allclose(got["mean_height"], b["mean_height"], rtol=0, atol=10 * off, err_msg="mean_height")
    for name in ("weight", "expected_count"):
        np.testing.assert_allclose(got[name], b[name], rtol=1e-9, err_msg=name)
    # std_dev^2 = m2 / (W - W2/W): a spread below the error of the means is rounding in both.
    np.testing.assert_allclose(got["std_dev"] ** 2, b["std_dev"] ** 2, rtol=1e-5, atol=off, err_msg="std_dev")
    np.testing.assert_allclose(got["confidence_factor"], b["confidence_factor"], rtol=1e-8 + 1e4 * off)
    spread = b["std_dev"] > 1e-4
    for name in ("confidence_level", "mean_variance"):
        np.testing.assert_array_equal(np.isnan(got[name]), np.isnan(b[name]), err_msg=name)
        np.testing.assert_allclose(got[name][spread], b[name][spread], rtol=1e-5, atol=1e-12, err_msg=name)
    side = m.cell_size
    for name in ("gradient_x", "gradient_y", "slope"):
        np.testing.assert_allclose(got[name], b[name], rtol=1e-9, atol=20 * off / side, err_msg=name)
    np.testing.assert_allclose(got["step_height"], b["step_height"], rtol=0, atol=20 * off, err_msg="step_height")
    # A term is 1 at a spread of zero and falls by 1 over its limit; if the spread is rounding, it is near 1 in both.
    np.testing.assert_allclose(got["traversability"], b["traversability"], rtol=0, atol=1e-4, err_msg="traversability")


def over_cells(m: Any, cells: np.ndarray, names: Iterable[str], **options: Any) -> tuple[dict[str, np.ndarray], int]:
    """Return layers of a map at the cells (M, 2), and the number of known cells in the smallest box around them."""
    (i0, j0), (i1, j1) = cells.min(axis=0), cells.max(axis=0) + 1
    side = m.cell_size * (1 << options.get("level", 0))
    r = m.region((i0 * side, j0 * side, i1 * side, j1 * side), [*names, "count"], **options)
    assert r.shape == (j1 - j0, i1 - i0)
    rows, columns = cells[:, 1] - j0, cells[:, 0] - i0
    return {name: r[name][rows, columns] for name in names}, int(np.count_nonzero(r["count"]))
