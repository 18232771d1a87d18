"""What a map of the ground says of simple places, from points to layers."""

import math

import numpy as np
import pytest

from roughmap import RoughMap

SIDE = 0.1
LAYERS = ("mean_height", "slope", "step_height", "roughness", "obstacle", "obstacle_top", "overhang_low",
          "traversability", "gradient_x", "gradient_y")  # fmt: skip


def floor(height: float = 0.0, box: tuple[float, float, float, float] = (-3.0, -3.0, 3.0, 3.0)) -> np.ndarray:
    """Sixteen points in each cell of a box."""
    x, y = np.meshgrid(*(np.arange(low + 0.0125, high, 0.025) for low, high in (box[::2], box[1::2])))
    return np.column_stack((x.ravel(), y.ravel(), np.full(x.size, height)))


def seen(*points: np.ndarray, up: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Layers of the 20 x 20 cells around the origin."""
    with RoughMap(cell_size=SIDE, error_model="point", surface="ground", threads=1) as m:
        for part in points:
            m.add(part, stamp_ns=10**9)
        if up is not None:
            m.add(up, stamp_ns=10**9, up=np.ones(len(up), np.bool_))
        region = m.region((-1.0, -1.0, 1.0, 1.0), LAYERS)
        return {name: region[name] for name in LAYERS}


def test_flat_ground() -> None:
    got = seen(floor(5.0))
    for name in ("slope", "step_height", "roughness", "obstacle"):
        np.testing.assert_allclose(got[name], 0.0, atol=1e-7)
    assert (got["mean_height"] == 5.0).all()
    assert got["traversability"].min() > 0.99
    assert np.isnan(got["obstacle_top"]).all()


@pytest.mark.parametrize("degrees", [5.0, 15.0, 25.0, 28.0])
def test_a_slope_is_a_slope_and_no_step(degrees: float) -> None:
    tilted = floor()
    tilted[:, 2] = 100.0 + math.tan(math.radians(degrees)) * (0.8 * tilted[:, 0] - 0.6 * tilted[:, 1])
    got = seen(tilted)
    # a plane's weighted fit is exact but for the rounding of heights around 100 m
    np.testing.assert_allclose(np.degrees(got["slope"]), degrees, atol=1e-6)
    np.testing.assert_allclose(got["roughness"], 0.0, atol=1e-5)
    assert (got["gradient_x"] > 0).all()
    assert (got["gradient_y"] < 0).all()
    assert got["traversability"].min() > 0.0


def test_a_kerb_blocks_above_it_and_tilts_nothing() -> None:
    got = seen(floor(0.0, (-3.0, -3.0, 0.0, 3.0)), floor(0.25, (0.0, -3.0, 3.0, 3.0)))
    np.testing.assert_allclose(got["slope"][:, :7], 0.0, atol=1e-9)
    assert (got["traversability"][:, 10:13] == 0.0).all()
    np.testing.assert_allclose(got["step_height"][:, 10:13], 0.25)
    np.testing.assert_allclose(got["step_height"][:, :10], 0.0, atol=1e-12)  # below it nothing falls
    assert (got["traversability"][:, 13:] > 0.9).all()


def test_a_roof_hangs_a_table_blocks() -> None:
    ground = floor()
    roof, table = floor(2.6, (-1.0, -1.0, 0.0, 1.0)), floor(0.75, (0.3, -0.4, 0.9, 0.4))
    got = seen(ground, roof, table)
    np.testing.assert_allclose(got["mean_height"], 0.0, atol=1e-12)
    assert (got["traversability"][:, :10] > 0.9).all()
    np.testing.assert_allclose(got["overhang_low"][:, :10], 2.625, atol=0.03)
    blocked = got["obstacle"] > 0
    np.testing.assert_allclose(got["obstacle_top"][blocked], 0.775, atol=0.03)
    assert blocked[6:14, 13:19].all()
    assert (got["traversability"][blocked] == 0.0).all()
    assert np.count_nonzero(blocked) == 48


def test_one_stray_is_neither_ground_nor_obstacle() -> None:
    stray = np.array([[0.05, 0.05, 0.9]])
    got = seen(floor(), stray)
    assert not got["obstacle"].any()
    lone = seen(floor(0.0, (-3.0, -3.0, -0.5, 3.0)), stray)
    assert np.isnan(lone["mean_height"][10, 10])
    assert np.isnan(lone["traversability"][10, 10])


def test_a_deck_alone_over_the_ground_is_not_known() -> None:
    """Where the ground below was never hit, a deck 2.3 m above its surroundings must not look like ground."""
    hole = np.concatenate([floor(0.0, (-3.0, -3.0, -0.25, 3.0)), floor(0.0, (0.25, -3.0, 3.0, 3.0))])
    got = seen(hole, floor(2.3, (-0.25, -1.0, 0.25, 1.0)))
    middle = got["mean_height"][:, 8:12]
    assert np.isnan(middle).all()
    assert (got["mean_height"][:, 13:] == 0.0).all()


def test_few_cells_have_no_plane_but_may_have_a_step() -> None:
    three = np.array([[0.05, 0.05, 0.0], [0.15, 0.05, 0.0], [0.05, 0.15, 0.5]]).repeat(4, axis=0)
    got = seen(three)
    assert np.isnan(got["slope"]).all()
    assert got["step_height"][10, 10] == 0.0
    assert got["traversability"][11, 10] == 0.0
    assert np.isnan(got["traversability"][10, 10])
