"""The layers of trust against formulas of their own, over simulated cells of all kinds; the quantiles by scipy."""

import numpy as np
import pytest
from confidence_map import cells_of, maps
from confidence_running import interval_95, local, stated, whole
from confidence_scene import GROUNDS, POSES, SIDE, A, scene

TILES = 6
NAMES = ("mean_sigma", "interval_95", "confidence", "local_confidence", "confidence_level")

CLOSE = 1e-4
"""Student's t is a closed approximation in the layers."""


@pytest.mark.parametrize("ground", GROUNDS)
@pytest.mark.parametrize("poses", POSES)
def test_layers_of_trust(poses: str, ground: str) -> None:
    ((_, m),) = maps(scene(3, ground, poses, TILES), "cuboid", "ground")
    cells = cells_of(m)
    sigma, _ = whole(cells)
    for tolerance in (0.005, 0.02, 0.05, 0.2):
        r = m.region((0.0, 0.0, TILES * 64 * A, 64 * A), NAMES, height_tolerance=tolerance)
        got = {name: r[name][cells.j, cells.i] for name in NAMES}
        # A ground that nothing supports is not known; all that is known has its trust.
        known = ~np.isnan(got["mean_sigma"])
        assert known.sum() >= 0.9 * TILES * SIDE**2
        half = np.full(len(sigma), tolerance / 2.0)
        ours, paper = stated(cells, half)
        wanted = {
            "mean_sigma": sigma, "interval_95": interval_95(cells), "confidence": ours,
            "local_confidence": local(cells, half),
        }  # fmt: skip
        for name, values in wanted.items():
            np.testing.assert_array_equal(np.isnan(got[name]), ~known, err_msg=name)
            np.testing.assert_allclose(got[name][known], values[known], rtol=CLOSE, atol=CLOSE, err_msg=name)
        both = known & ~np.isnan(paper)
        np.testing.assert_allclose(got["confidence_level"][both], paper[both], atol=CLOSE)
