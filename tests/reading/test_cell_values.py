"""Layers drawn by the kernel: to the bit what array arithmetic gives, in every form and for any records."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from read_tools import chance_tile

from roughmap import RoughMap
from roughmap.cell import CELL_DTYPE
from roughmap.reading.cell_values import cell_layers, known_bits, packed_cell_layers
from roughmap.reading.layers import CELL_LAYERS, SINGLE_POINT, layers_of
from roughmap.reference.error_function import erf


class Plainly:
    """The layers by numpy, plane by plane."""

    def __init__(self, records: np.ndarray, tolerance: float, newest: int) -> None:
        self.records, self.tolerance, self.newest = records, tolerance, newest
        self.weight, self.weight_sq = records["weight"], records["weight_sq"]
        self.expected = self.known(self.weight * self.weight / self.weight_sq)
        spread = np.sqrt(records["m2"] / (self.weight - self.weight_sq / self.weight))
        several = (records["count"] >= 2) & (self.expected > SINGLE_POINT)
        self.std_dev = np.where(several, spread, np.nan)

    def known(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.records["count"] == 0, np.nan, values)

    def layer(self, name: str) -> np.ndarray:
        r = self.records
        formulas: dict[str, Callable[[], np.ndarray]] = {
            "mean_height": lambda: self.known(r["mean"]),
            "mid_range_height": lambda: self.known(0.5 * (r["max"] + r["min"])),
            "max_height": lambda: self.known(r["max"]),
            "min_height": lambda: self.known(r["min"]),
            "std_dev": lambda: self.std_dev,
            "range": lambda: self.known(r["max"] - r["min"]),
            "confidence_level": lambda: erf(
                self.tolerance * np.sqrt(self.expected) / (2.0 * self.std_dev) / np.sqrt(2.0)
            ),
            "confidence_factor": lambda: self.known(1.0 / r["inv_cf"]),
            "mean_variance": lambda: self.std_dev**2 / self.expected,
            "count": lambda: r["count"].astype(np.float64),
            "weight": lambda: r["weight"].astype(np.float64),
            "expected_count": lambda: self.expected,
            "age": lambda: self.known(float(self.newest) - r["updated"]),
        }
        return formulas[name]()


def bits(values: np.ndarray) -> bytes:
    """The bytes of values, where one NaN is as good as another."""
    return np.where(np.isnan(values), np.nan, values).astype(values.dtype).tobytes()


NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
CELLS = st.lists(
    st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), *[NUMBERS] * 7), min_size=8, max_size=8
).map(lambda cells: np.array(cells, CELL_DTYPE))
TILES = st.builds(chance_tile, st.integers(0, 1000), st.sampled_from([0.0, 0.1, 0.7, 1.0]))
LAYER_LISTS = st.lists(st.sampled_from(CELL_LAYERS), unique=True, max_size=len(CELL_LAYERS))


@examples(60)
@given(CELLS | TILES, LAYER_LISTS, st.floats(1e-6, 1e3), st.integers(0, 2**32 - 1))
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_any_records(records: np.ndarray, names: list[str], tolerance: float, newest: int) -> None:
    plainly = Plainly(records, tolerance, newest)
    planes = cell_layers(records, names, tolerance, newest)
    packed = packed_cell_layers(records, names, tolerance, newest)
    assert list(planes) == names
    assert packed.shape == (*records.shape, len(names))
    for number, (name, plane) in enumerate(planes.items()):
        expected = plainly.layer(name)
        if name == "confidence_level":  # the oracle's error function is the C library's; ours is good to 1e-10
            np.testing.assert_allclose(plane, expected, rtol=0, atol=2e-10)
            expected = plane
        assert bits(plane) == bits(expected), name
        assert bits(packed[..., number]) == bits(expected.astype(np.float32)), name


@given(TILES)
def test_known_cells(tile: np.ndarray) -> None:
    known = tile["count"] != 0
    assert known_bits(tile) == (np.count_nonzero(known), np.packbits(known).tobytes())


@given(st.lists(st.sampled_from(layers_of("all")), unique=True, min_size=1))
def test_a_packed_tile_has_the_values_of_its_layers(names: list[str]) -> None:
    rng = np.random.default_rng(5)
    with RoughMap(threads=1) as m:
        points = np.column_stack((rng.uniform(-7.0, 7.0, (400, 2)), rng.normal(0.0, 0.1, 400)))
        m.add(points, np.eye(3) * 1e-3, 10**9)
        for level in (0, 1):
            with m.freeze(level) as frozen:
                for x, y in [*frozen.tiles.tolist(), (90, 90)]:
                    layers = frozen.tile_layers(x, y, names)
                    packed = frozen.packed_layers(x, y, names)
                    expected = np.stack(list(layers.values()), axis=-1).astype(np.float32)
                    assert packed.tobytes() == expected.tobytes()
