"""A tile whose sequence has not changed has the layers that it had, at every level, whatever changed beside it."""

import numpy as np
import pytest
from ground_worlds import cut, loaded, world
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap import RoughMap
from roughmap.cell import TILE_CELLS
from roughmap.reading.layers import layers_of
from roughmap.tiles.changes import rings

LEVELS = 4
STAMP = 99 * 10**9
"""That of the newest tile, so that no age changes."""


def layers(m: RoughMap, level: int) -> dict[tuple[int, int], dict[str, bytes]]:
    with m.freeze(level) as frozen:
        names = layers_of(m.settings.surface)
        return {
            (x, y): {name: plane.tobytes() for name, plane in frozen.tile_layers(x, y, names).items()}
            for x, y in frozen.tiles.tolist()
        }


def sequences(m: RoughMap, level: int) -> dict[tuple[int, int], int]:
    with m.freeze(level) as frozen:
        return {(x, y): n for (x, y), n in zip(frozen.tiles.tolist(), frozen.sequences.tolist(), strict=True)}


def again(m: RoughMap) -> RoughMap:
    """Return a map of the same tiles that no reader has read, so that nothing is cached."""
    with m.freeze() as frozen:
        tiles = {(x, y): frozen.state(x, y) for x, y in frozen.tiles.tolist()}
        return loaded({place: state for place, state in tiles.items() if state}, m.cell_size, m.settings.surface)


@examples(8)
@given(st.integers(0, 10**6), st.sampled_from([0.05, 0.06, 0.1, 0.25]), st.sampled_from(["ground", "ground", "all"]))
def test_layers_change_with_the_sequence_alone(seed: int, side: float, surface: str) -> None:
    """Points fall about as far from the borders of tiles as the ring of level 0 is wide, on both sides.

    They are far below the ground, which then hangs over them, or on it, or above, in known and in unknown cells.
    """
    rng = np.random.default_rng(seed)
    shape, first = np.array([200, 200]), np.array([-70, -140])
    arrays = world(seed, (200, 200), side, holes=0.6)
    mean = arrays[0]["mean"]
    with loaded(cut(arrays, (-70, -140)), side, surface) as m:
        before = [layers(m, level) for level in range(LEVELS)]
        number = int(rng.integers(1, 4))
        away = rings(surface, side, 1)[0] + rng.integers(-4, 3, (number, 2))
        border = TILE_CELLS * rng.integers(-1, 2, (number, 2))
        cells = np.clip(border + np.where(rng.random((number, 2)) < 0.5, away, -away), first, first + shape - 1)
        z = np.median(mean[mean != 0.0]) + rng.choice([-3.0, -3.0, 0.0, 0.3], number)
        m.add(np.repeat(np.column_stack([(cells + 0.5) * side, z]), rng.integers(1, 3), axis=0), stamp_ns=STAMP)
        with again(m) as fresh:
            for level, old in enumerate(before):
                now, seen = layers(fresh, level), layers(m, level)
                for tile, sequence in sequences(m, level).items():
                    assert seen[tile] == now[tile], "cached for longer than it is true"
                    if sequence < m.sequence:
                        assert now[tile] == old[tile], (level, tile)


@pytest.mark.parametrize("side", [0.05, 0.06, 0.08, 0.1, 0.25])
def test_the_farthest_cell_that_counts(side: float) -> None:
    """A pit of two cells with a point each, in uneven ground west of tile (0, 0); the farther point comes later.

    One alone is not confirmed. Together they are, and ground at the edge of their window hangs over them. That takes it
    from the plane of a cell at the edge of its footprint, (0, 40): under its cells of levels 1 to 3 the only known one,
    and so the worst.
    """
    ring = rings("ground", side, 1)[0]
    rng = np.random.default_rng(1)
    i, j = (numbers.ravel() for numbers in np.meshgrid(np.arange(-30, 20), np.arange(20, 60)))
    z = rng.normal(0.0, 0.02, i.size)
    for away in range(ring - 2, ring + 3):
        with RoughMap(cell_size=side, error_model="point", levels=LEVELS, threads=1) as m:
            pit = (j == 40) & ((i == -away) | (i == 1 - away))
            beside = (i >> 3 == 0) & (j >> 3 == 5) & ((i > 0) | (j > 40))
            ground = np.column_stack([(i + 0.5) * side, (j + 0.5) * side, z])[~(pit | beside)]
            m.add(np.concatenate([ground, ground, [[(1.5 - away) * side, 40.5 * side, -3.0]]]), stamp_ns=STAMP)
            before = [layers(m, level) for level in range(LEVELS)]
            m.add([[(0.5 - away) * side, 40.5 * side, -3.0]], stamp_ns=STAMP)
            with again(m) as fresh:
                for level, old in enumerate(before):
                    new = layers(fresh, level)[0, 0]
                    assert layers(m, level)[0, 0] == new
                    changed = new["traversability"] != old[0, 0]["traversability"]
                    assert changed == (away <= ring)
                    assert not changed or sequences(m, level)[0, 0] == m.sequence


@examples(200)
@given(
    st.floats(0.01, 1.0)
    | st.builds(lambda m, n: m / (n + 0.5), st.sampled_from([0.15, 0.25, 0.3, 0.5]), st.integers(0, 12))
)
def test_rings_above_are_at_least_as_wide_as_that_of_level_0(side: float) -> None:
    """Above level 0 a tile also tells the worst of its cells of level 0, which depends on their ring."""
    widths = rings("ground", side, 6)
    assert min(width << level for level, width in enumerate(widths)) == widths[0]
