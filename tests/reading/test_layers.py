"""Every layer computed from a cell's own record, by hand."""

from math import nan, sqrt
from statistics import NormalDist

import numpy as np
import pytest
from read_tools import cell_of

from roughmap.cell import CELL_DTYPE
from roughmap.reading.cell_values import cell_layers
from roughmap.reading.layers import (
    CELL_LAYERS,
    DEFAULT_LIMITS,
    GROUND_LAYERS,
    LAYERS,
    LIMIT_NAMES,
    MAX_CLEARANCE,
    check_ground_limits,
    check_limits,
    check_names,
    check_tolerance,
    layers_of,
)
from roughmap_schemas import layers as contract

UNKNOWN = np.zeros((), dtype=CELL_DTYPE)


def read(record: np.ndarray, tolerance: float = 0.05, newest: int = 0) -> dict[str, float]:
    return {name: float(plane) for name, plane in cell_layers(record, CELL_LAYERS, tolerance, newest).items()}


def test_the_layers_of_the_contract_in_its_order() -> None:
    assert (
        *("mean_height", "mid_range_height", "max_height", "min_height", "std_dev", "range", "confidence_level"),
        *("confidence_factor", "mean_variance", "count", "weight", "expected_count", "age"),
        *("mean_sigma", "interval_95", "confidence", "local_confidence"),
        *("gradient_x", "gradient_y", "slope", "step_height", "traversability"),
        *("roughness", "obstacle", "obstacle_top", "overhang_low", "passable_share"),
    ) == LAYERS
    assert LAYERS == contract.LAYERS
    assert GROUND_LAYERS == contract.GROUND_LAYERS
    assert LIMIT_NAMES == contract.LIMIT_NAMES
    assert DEFAULT_LIMITS == contract.DEFAULT_LIMITS
    assert MAX_CLEARANCE == contract.MAX_CLEARANCE
    for surface in ("ground", "all"):
        assert layers_of(surface) == contract.layers_of(surface)


def test_three_points() -> None:
    """Heights 1.0, 1.1, 1.5: the mean is 1.2, the squares sum to 0.04 + 0.01 + 0.09 = 0.14, over 3 - 1."""
    got = read(cell_of([1.0, 1.1, 1.5], updated=7), newest=19)
    assert got["mean_height"] == pytest.approx(1.2)
    assert got["mid_range_height"] == 1.25
    assert (got["max_height"], got["min_height"]) == (1.5, 1.0)
    assert got["std_dev"] == pytest.approx(sqrt(0.07))
    assert got["range"] == 0.5
    x = 0.05 * sqrt(3) / (2 * sqrt(0.07))
    assert got["confidence_level"] == pytest.approx(2 * NormalDist().cdf(x) - 1)
    assert got["confidence_factor"] == pytest.approx(1 / 3e6)
    assert got["mean_variance"] == pytest.approx(0.07 / 3)
    assert (got["count"], got["weight"], got["expected_count"], got["age"]) == (3.0, 3.0, 3.0, 12.0)


def test_weights() -> None:
    """Heights 0 and 1 with weights 3 and 1: mean 1/4, m2 = 3/16 + 9/16, n = 16/10, and m2 over 4 - 10/4."""
    got = read(cell_of([0.0, 1.0], [3.0, 1.0]), tolerance=0.2)
    assert got["mean_height"] == 0.25
    assert got["expected_count"] == pytest.approx(1.6)
    assert got["std_dev"] == pytest.approx(sqrt(0.5))
    x = 0.2 * sqrt(1.6) / (2 * sqrt(0.5))
    assert got["confidence_level"] == pytest.approx(2 * NormalDist().cdf(x) - 1)
    assert got["mean_variance"] == pytest.approx(0.5 / 1.6)


def test_one_point_has_no_spread() -> None:
    got = read(cell_of([4.0]))
    spread = ("std_dev", "confidence_level", "mean_variance")
    assert all(np.isnan(got[name]) for name in spread)
    assert not any(np.isnan(got[name]) for name in CELL_LAYERS if name not in spread)
    assert got["range"] == 0.0


@pytest.mark.parametrize(("light", "known"), [(1e-3, True), (1e-8, False)])
def test_a_sliver_beside_a_whole_point_has_no_spread(light: float, known: bool) -> None:
    """n is 1 + 2 light to first order: 1.002 has a spread, 1 + 2e-8 lies within 1 + 1e-6."""
    got = read(cell_of([1.0, 2.0], [1.0, light]))
    assert np.isnan(got["std_dev"]) != known
    assert np.isnan(got["confidence_level"]) != known


def test_equal_heights_are_certain() -> None:
    got = read(cell_of([2.5, 2.5]))
    assert (got["std_dev"], got["confidence_level"], got["mean_variance"]) == (0.0, 1.0, 0.0)


def test_confidence_is_unknown_exactly_where_the_spread_is() -> None:
    records = np.stack([cell_of([1.0]), cell_of([1.0, 1.0]), cell_of([1.0, 3.0]), UNKNOWN])
    got = cell_layers(records, ("std_dev", "confidence_level"), 1e-300, 0)
    assert (np.isnan(got["std_dev"]) == np.isnan(got["confidence_level"])).all()


def test_an_unknown_cell() -> None:
    got = read(UNKNOWN, newest=50)
    assert {name for name in CELL_LAYERS if not np.isnan(got[name])} == {"count", "weight"}
    assert (got["count"], got["weight"]) == (0.0, 0.0)


def test_the_asked_order_and_any_shape() -> None:
    records = np.broadcast_to(cell_of([1.0, 2.0]), (3, 4, 5))
    got = cell_layers(records, ("range", "mean_height"), 0.05, 0)
    assert list(got) == ["range", "mean_height"]
    assert all(plane.shape == (3, 4, 5) and plane.dtype == np.float64 for plane in got.values())


def test_names() -> None:
    assert check_names(["slope", "age"]) == ("slope", "age")
    assert check_names("slope") == ("slope",)
    with pytest.raises(ValueError, match=r"'heigth'.*mean_height"):
        check_names(["mean_height", "heigth"])
    assert check_names(["mean_sigma"], "all") == ("mean_sigma",)
    with pytest.raises(ValueError, match=r"'roughness'.*'ground'"):
        check_names(["roughness"], "all")


@pytest.mark.parametrize("tolerance", [0.0, -1.0, nan, float("inf")])
def test_a_tolerance_is_positive(tolerance: float) -> None:
    with pytest.raises(ValueError, match="height_tolerance"):
        check_tolerance(tolerance)


def test_limits() -> None:
    inf = float("inf")
    assert check_limits(None) == (0.5, 0.2, 0.1, inf, 0.9)
    assert check_limits({"range": 0.3, "slope": 1}) == (1.0, inf, inf, 0.3, inf)


def test_limits_of_the_ground() -> None:
    """Each has its default, since each decides what a plane or an object is."""
    assert check_ground_limits(None) == check_ground_limits({}) == (0.5, 0.2, 0.1, 0.9, 2.0)
    assert check_ground_limits({"clearance": 2.5, "step": 0.3}) == (0.5, 0.3, 0.1, 0.9, 2.5)


@pytest.mark.parametrize(
    "limits",
    [{"std_dev": 0.1}, {"range": 0.1}, {"clearance": 2.6}, {"step": 0.0}, {"slope": nan}, {"confidence": 1e999}],
)
def test_bad_limits_of_the_ground(limits: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(limits))):
        check_ground_limits(limits)


@pytest.mark.parametrize("limits", [{"slop": 0.5}, {"slope": 0.0}, {"step": -1.0}, {"range": nan}, {"step": 1e999}, {}])
def test_bad_limits(limits: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="limit"):
        check_limits(limits)
