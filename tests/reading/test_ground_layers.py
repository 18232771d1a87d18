"""The layers of a map of the ground against their definitions, over random ground."""

import numpy as np
import pytest
from ground_by_definition import ByDefinition, CoarseByDefinition
from ground_worlds import cut, loaded, world
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap.reading.layers import LAYERS

# heights of 300 m carry 6e-14, their squares' differences over a footprint more; probabilities are good to 3e-5
CLOSE = {"confidence": 4e-5, "local_confidence": 4e-5, "traversability": 1e-4}
LIMITS = st.fixed_dictionaries(
    {},
    optional={
        "slope": st.sampled_from([0.2, 0.9, 2.0]),
        "step": st.sampled_from([0.05, 0.5]),
        "roughness": st.just(0.03),
        "confidence": st.just(0.5),
        "clearance": st.sampled_from([0.5, 1.2, 2.5]),
    },
)


def agree(got: dict[str, np.ndarray], row: int, column: int, expected: dict[str, float]) -> None:
    for name, value in expected.items():
        mine = got[name][row, column]
        near = 4e-6 if name == "interval_95" else 1e-6
        assert mine == pytest.approx(value, rel=near, abs=CLOSE.get(name, 1e-7), nan_ok=True), (name, row, column)


def sample(rng: np.random.Generator, number: int) -> list[tuple[int, int]]:
    """Cells of a tile: along its borders, and some within."""
    edge = [(row, column) for row in (0, 1, 62, 63) for column in (0, 63, int(rng.integers(64)))]
    return edge + [tuple(pair) for pair in rng.integers(0, 64, (number, 2)).tolist()]


@examples(15)
@given(
    st.integers(0, 10**6), st.sampled_from([0.05, 0.1, 0.1, 0.2, 0.35, 0.8]), st.sampled_from([0.0, 0.3, 0.8]),
    st.sampled_from([0.0, 0.02, 0.4]), LIMITS,
)  # fmt: skip
def test_level_0(seed: int, side: float, holes: float, objects: float, limits: dict[str, float]) -> None:
    rng = np.random.default_rng(seed)
    arrays = world(seed, (150, 150), side, holes=holes, objects=objects)
    tiles = cut(arrays, (-40, -90))
    if seed % 3 == 0:
        del tiles[min(tiles)]
    definition = ByDefinition(tiles, side, limits)
    with loaded(tiles, side) as m, m.freeze() as frozen:
        for x, y in ((-1, -1), (0, -1)):
            got = frozen.tile_layers(x, y, LAYERS, limits=limits)
            for row, column in sample(rng, 30):
                agree(got, row, column, definition.layers(64 * x + column, 64 * y + row))


@examples(6)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.1, 0.35]), st.integers(1, 3), LIMITS)
def test_levels_above(seed: int, side: float, level: int, limits: dict[str, float]) -> None:
    rng = np.random.default_rng(seed)
    tiles = cut(world(seed, (260, 200), side, holes=0.5), (-100, -140))
    fine = ByDefinition(tiles, side, limits)
    definition = CoarseByDefinition(fine, level)
    with loaded(tiles, side) as m, m.freeze(level, (-1, -1, -1, -1)) as frozen:
        got = frozen.tile_layers(-1, -1, LAYERS, limits=limits)
        known = np.argwhere(got["count"] > 0)
        inside = [tuple(pair) for pair in rng.permutation(known)[:12].tolist()]
        for row, column in [*inside, (63, 63), (0, 0), (63, 40)]:
            agree(got, row, column, definition.layers(column - 64, row - 64))


@examples(10)
@given(st.integers(0, 10**6), st.integers(-70, 70), st.integers(-70, 70))
def test_where_tiles_begin_does_not_matter(seed: int, di: int, dj: int) -> None:
    """The same ground, some cells on: the same layers to the bit, but for what is borrowed from the tile."""
    arrays = world(seed, (100, 110), 0.1)
    names = [name for name in LAYERS if name not in {"mean_sigma", "interval_95", "confidence", "local_confidence"}]
    limits = {"confidence": 1e-9}
    found = []
    for corner in ((0, 0), (di, dj)):
        with loaded(cut(arrays, corner), 0.1) as m:
            box = tuple((corner[axis] + edge) * 0.1 for edge, axis in ((0, 0), (0, 1), (110, 0), (100, 1)))
            region = m.region(box, names, limits=limits)
            found.append({name: region[name].tobytes() for name in names})
    assert found[0] == found[1]


@given(st.integers(0, 10**6), st.lists(st.sampled_from(LAYERS), unique=True, min_size=1), st.integers(0, 2))
def test_any_layers_together(seed: int, names: list[str], level: int) -> None:
    """What else is asked for changes nothing, packed or not."""
    tiles = cut(world(seed % 5, (70, 70), 0.1), (-3, -3))
    with loaded(tiles, 0.1) as m, m.freeze(level) as frozen:
        for x, y in (*frozen.tiles.tolist()[:2], (50, 50)):
            every, some = frozen.tile_layers(x, y, LAYERS), frozen.tile_layers(x, y, names)
            packed = frozen.packed_layers(x, y, names)
            assert list(some) == names
            for number, name in enumerate(names):
                np.testing.assert_array_equal(some[name], every[name])
                np.testing.assert_array_equal(packed[:, :, number], every[name].astype(np.float32))


def test_known_cells_agree_over_all_layers() -> None:
    """A cell's ground is known in all layers of cells, or in none; trust never lacks there."""
    with loaded(cut(world(3, (128, 128), 0.1), (0, 0)), 0.1) as m, m.freeze() as frozen:
        got = frozen.tile_layers(0, 0, LAYERS)
    known = np.isfinite(got["mean_height"])
    assert 0 < known.sum() < (frozen_count := got["count"].size) == 4096, frozen_count
    for name in ("count", "weight"):
        np.testing.assert_array_equal(got[name] > 0, known)
    for name in ("min_height", "range", "age", "mean_sigma", "interval_95", "confidence", "local_confidence",
                 "step_height", "obstacle"):  # fmt: skip
        np.testing.assert_array_equal(np.isfinite(got[name]), known, err_msg=name)
