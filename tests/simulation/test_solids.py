"""A beam meets a solid where it enters it: against a march along the beam in small steps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap_service.simulation.solids import BOX, CYLINDER, ELLIPSOID, extent, meet, solid

SIDE = st.floats(0.05, 3.0)
PLACE = st.floats(-4.0, 4.0)
STEP = 1e-3


def inside(one: np.ndarray, points: np.ndarray) -> np.ndarray:
    low, high = extent(one, 0, points[:, 0] - one["x"][0], points[:, 1] - one["y"][0])
    return (points[:, 2] >= low) & (points[:, 2] <= high)


@given(
    st.sampled_from([BOX, CYLINDER, ELLIPSOID]),
    st.tuples(PLACE, PLACE, PLACE),
    st.tuples(SIDE, SIDE, SIDE),
    st.floats(0, 2 * np.pi),
    st.floats(-1.2, 1.2),
)
def test_a_beam_ends_where_it_enters(
    shape: int, centre: tuple[float, float, float], half: tuple[float, float, float], azimuth: float, elevation: float
) -> None:
    one = solid(shape, centre, half)
    flat = np.cos(elevation)
    direction = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    hit = meet(one[0], 0.0, 0.0, 0.0, *direction, 0.5)
    ranges = np.arange(0.0, 14.0, STEP)  # the furthest corner is sqrt(3) * 7 m away
    within = np.flatnonzero(inside(one, ranges[:, None] * direction))
    if within.size > 2:  # fewer may be a corner that one of the two just misses
        assert ranges[within[0]] - STEP <= hit <= ranges[within[0]] + 1e-9
    elif within.size == 0:
        # Between two steps of the march, a beam cuts at most STEP of a corner.
        assert hit == np.inf or inside(one, ((hit + np.linspace(0, STEP, 50))[:, None]) * direction).any()


def test_glass_returns_its_share_and_leaves_stop_beams_by_their_length() -> None:
    chances = (np.arange(10_000) + 0.5) / 10_000
    pane = solid(BOX, (5.0, 0.0, 0.0), (0.01, 2.0, 2.0), share=0.3)
    assert np.mean([meet(pane[0], 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, chance) < np.inf for chance in chances]) == 0.3
    crown = solid(ELLIPSOID, (5.0, 0.0, 0.0), (1.0, 1.0, 1.0), density=1.5)
    hits = np.array([meet(crown[0], 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, chance) for chance in chances])
    # 2 m of leaves, 1.5 a metre: exp(-3) come through; the chances are a grid of 1e-4.
    assert np.mean(np.isinf(hits)) == pytest.approx(np.exp(-3.0), abs=2e-4)
    assert np.all((hits[np.isfinite(hits)] >= 4.0) & (hits[np.isfinite(hits)] <= 6.0))
