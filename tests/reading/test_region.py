"""Regions: the cells that a box covers, and layers over several tiles."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap.map import RoughMap
from roughmap.reading.layers import layers_of
from roughmap.reading.region import MAX_CELLS, cell_box, read_region
from roughmap.settings import SURFACES


def test_an_edge_within_rounding_of_a_border_lies_on_it() -> None:
    """0.3 / 0.1 is 2.9999999999999996 and 0.7 / 0.1 is 6.999999999999999: three cells and seven."""
    assert cell_box((0.3, 0.0, 0.7, 0.3), 0.1) == (3, 0, 7, 3)
    assert cell_box((0.0, 0.0, 0.3, 0.6), 0.1) == (0, 0, 3, 6)
    assert cell_box((-0.3, -0.7, 0.0, 0.0), 0.1) == (-3, -7, 0, 0)


def test_a_cell_that_is_only_touched_is_covered() -> None:
    assert cell_box((0.05, -0.01, 0.11, 0.01), 0.1) == (0, -1, 2, 1)


@given(i=st.integers(-(10**6), 10**6), n=st.integers(1, 60), side=st.sampled_from([0.1, 0.05, 0.3, 1.0, 0.7]))
def test_multiples_of_the_cell_side_are_whole(i: int, n: int, side: float) -> None:
    assert cell_box((i * side, -i * side, (i + n) * side, (n - i) * side), side) == (i, -i, i + n, n - i)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((0, 0, nan, 1), "finite"),
        ((0, -inf, 1, 1), "finite"),
        ((0, 0, 1e308, 1), "finite"),
        ((0, 0, 0, 1), "empty"),
        ((1, 0, 0, 1), "empty"),
        ((0.05, 0, 0.03, 1), "empty"),
        ((0.3, 0, 0.3 + 1e-9, 1), "too narrow"),
        ((0, 0, 1), "four"),
        ((0, 0, 1, 1, 1), "four"),
        ((0, 0, 1e30, 1e30), "at most"),
        ((0, 0, 819.3, 819.2), "at most"),
    ],
)
def test_bad_boxes(box: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        cell_box(box, 0.1)


def test_the_largest_box() -> None:
    i0, j0, i1, j1 = cell_box((0, 0, 819.2, 819.2), 0.1)
    assert (i1 - i0) * (j1 - j0) == MAX_CELLS


@pytest.fixture(params=SURFACES)
def m(request: pytest.FixtureRequest) -> RoughMap:
    """Return ground with two thirds of the cells known, over tiles around the origin."""
    rng = np.random.default_rng(4)
    m = RoughMap(cell_size=0.1, error_model="point", surface=request.param, threads=1)
    points = np.column_stack((rng.uniform(-8.0, 8.0, (30000, 2)), rng.normal(0.0, 0.1, 30000)))
    m.add(points, stamp_ns=rng.integers(0, 10**11, 30000))
    return m


def test_the_region_itself(m: RoughMap) -> None:
    r = m.region((-0.5, 0.2, 1.0, 0.6), ["range", "mean_height"])
    assert list(r) == ["range", "mean_height"]
    assert len(r) == 2
    assert r.shape == (4, 15)
    assert r["range"].shape == (4, 15)
    assert r["range"].dtype == np.float64
    assert r.origin == pytest.approx((-0.5, 0.2))
    assert (r.cell_size, r.sequence, r.level) == (0.1, 1, 0)
    with pytest.raises(KeyError):
        r["slope"]


@pytest.mark.parametrize("surface", SURFACES)
def test_row_0_lies_lowest(surface: str) -> None:
    m = RoughMap(cell_size=0.5, error_model="point", surface=surface, threads=1)
    m.add([(0.7, 0.1, 5.0), (0.1, 1.2, 7.0)] * 2)
    r = m.region((0, 0, 1, 1.5), ["mean_height"])
    np.testing.assert_equal(r["mean_height"], [[nan, 5.0], [nan, nan], [7.0, nan]])


@pytest.mark.parametrize("level", [0, 1, 3])
def test_any_box_shows_the_same_ground(m: RoughMap, level: int) -> None:
    """A small box shows the same as that part of a large box, including neighbours outside the small box."""
    side, names = 0.1 * 2**level, layers_of(m.settings.surface)
    whole = m.region((-12.8, -12.8, 12.8, 12.8), names, level=level)
    n = round(12.8 / side)
    for i0, j0, i1, j1 in [(0, 0, 1, 1), (-1, -1, 1, 1), (-7, -n, 9, n), (-n, 3, n, 5)]:
        part = m.region((i0 * side, j0 * side, i1 * side, j1 * side), names, level=level)
        assert part.shape == (j1 - j0, i1 - i0)
        for name in names:
            np.testing.assert_array_equal(part[name], whole[name][n + j0 : n + j1, n + i0 : n + i1], err_msg=name)


def test_a_region_where_nothing_is_known(m: RoughMap) -> None:
    names = layers_of(m.settings.surface)
    for box in [(1e3, 1e3, 1e3 + 1, 1e3 + 1), (1e12, -1e12, 1e12 + 1, -1e12 + 1), (0, 1e20, 1, 1e20 + 2e4)]:
        r = m.region(box, names)
        for name in names:
            assert (r[name] == 0).all() if name in {"count", "weight"} else np.isnan(r[name]).all()


def test_the_options_reach_the_layers(m: RoughMap) -> None:
    box = (-3.0, -3.0, 3.0, 3.0)
    names = ["confidence_level", "traversability"]
    narrow, wide = (m.region(box, names, height_tolerance=d) for d in (0.01, 0.5))
    known = np.isfinite(narrow["confidence_level"]) & (narrow["confidence_level"] < 1.0)
    assert (narrow["confidence_level"][known] < wide["confidence_level"][known]).all()
    name, more = {
        "all": ("step", {}),
        # A step's limit says which neighbours a plane is fitted to as well.
        "ground": ("roughness", {"slope": 1.5, "step": 10.0, "confidence": 0.1}),
    }[m.settings.surface]
    strict, lax = (m.region(box, names, limits={name: limit, **more})["traversability"] for limit in (0.1, 10.0))
    known = np.isfinite(strict)
    assert (strict[known] <= lax[known]).all()
    assert strict[known].mean() < 0.5 < lax[known].mean()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"names": ["height"]}, "unknown layer 'height'"),
        ({"level": 8}, "level"),
        ({"level": -1}, "level"),
        ({"bbox": (0, 0, 0, 0)}, "empty"),
        ({"height_tolerance": 0.0}, "height_tolerance"),
        ({"limits": {"steep": 1.0}}, "unknown limit 'steep'"),
    ],
)
def test_bad_requests_change_nothing(m: RoughMap, arguments: dict[str, object], message: str) -> None:
    digest = m.digest()
    given = {"bbox": (0, 0, 1, 1), "names": ["range"], **arguments}
    with pytest.raises(ValueError, match=message):
        m.region(given.pop("bbox"), given.pop("names"), **given)
    assert (m.digest(), m.sequence) == (digest, 1)


def test_a_region_must_lie_in_the_frozen_map(m: RoughMap) -> None:
    with m.freeze(box=(0, 0, 0, 0)) as frozen:
        assert read_region(frozen, (0, 0, 6.4, 6.4), ["range"]).shape == (64, 64)
        with pytest.raises(ValueError, match="within"):
            read_region(frozen, (0, 0, 6.5, 6.4), ["range"])
