"""No-returns that a driver moved off zero: hundreds of points with the same coordinates are not returns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from service_tools import LEVEL, PRECISE, T0, config

from roughmap_schemas import Cloud, PointReason
from roughmap_service.run.placing import place_cloud
from roughmap_service.run.poses import Pose
from roughmap_service.run.returns import REPEATED, SAMPLED, repeated_returns
from roughmap_service.run.settings import Settings, new_map

S = 10**9


def viewed(points: np.ndarray) -> np.ndarray:
    """The points as a view of a payload: strided and not aligned."""
    packed = np.zeros(len(points), np.dtype([("tag", "u1"), ("xyz", points.dtype, (3,)), ("t", "<u4")]))
    packed["xyz"] = points
    width = points.itemsize
    view = np.ndarray(points.shape, points.dtype, packed.tobytes(), 1, (packed.itemsize, width))
    assert not view.flags.aligned
    return view


@examples(150)
@given(
    st.sampled_from(["<f4", "<f8"]),
    st.integers(1, 3 * SAMPLED),
    st.lists(
        st.tuples(
            st.sampled_from([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0), (-0.0, 0.0, 7.5), (1e-30, 2.0, 3.0), (np.nan, 0.0, 0.0),
                             (np.inf, 1.0, 1.0), (3.0, 4.0, 5.0)]),
            st.one_of(st.integers(1, REPEATED - 1), st.integers(1000, 1500)),
        ),
        max_size=4, unique_by=lambda item: item[0],
    ),
    st.integers(0, 2**32),
)  # fmt: skip
def test_those_points_and_no_others(
    dtype: str, number: int, equal: list[tuple[tuple[float, float, float], int]], seed: int
) -> None:
    """Zeros and what is not finite have reasons of their own."""
    random = np.random.default_rng(seed)
    rows = [random.uniform(-50.0, 50.0, (number, 3)), *(np.full((n, 3), value) for value, n in equal)]
    points = random.permutation(np.vstack(rows).astype(dtype))
    expected = np.zeros(len(points), np.bool_)
    for value, n in equal:
        if n >= REPEATED and np.isfinite(value).all() and any(value):
            expected |= (points == np.array(value, dtype)).all(axis=1)
    for given_points in (points, viewed(points)):
        marked = repeated_returns(given_points)
        assert (marked is None) == (not expected.any())
        assert marked is None or marked.tolist() == expected.tolist()


@pytest.mark.parametrize("number", [REPEATED - 1, REPEATED])
def test_where_it_begins(number: int) -> None:
    points = np.random.default_rng(0).normal(size=(SAMPLED, 3))
    points[-number:] = (0.0, 0.1, 0.0)
    marked = repeated_returns(points)
    assert (0 if marked is None else np.count_nonzero(marked)) == (number if number == REPEATED else 0)


def test_dual_returns_and_a_grid_are_returns() -> None:
    random = np.random.default_rng(0)
    assert repeated_returns(np.repeat(random.normal(size=(60_000, 3)), 2, axis=0)) is None
    x, y = np.meshgrid(np.linspace(-4, 4, 300), np.linspace(-4, 4, 300))
    assert repeated_returns(np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)) is None


@pytest.mark.parametrize(("rules", "frame"), [(2, "lidar"), (1, "lidar"), (2, "map")])
def test_they_are_counted_and_do_not_reach_the_map(rules: int, frame: str) -> None:
    """Not in clouds that are placed already, nor under the rules of older logs."""
    values = config()
    settings = Settings(values, rules=rules)
    poses = [Pose(T0 + k * S // 10, (0.0, 0.0, 1.0), LEVEL, PRECISE, k + 1, 0) for k in range(2)]
    ground = np.random.default_rng(0).uniform(1.0, 3.0, (500, 3)) * (1.0, 1.0, 0.0) - (0.0, 0.0, 1.0)
    points = np.vstack([ground[:200], np.full((1000, 3), (2.0, 2.0, 0.5)), ground[200:], np.zeros((5, 3))])
    cloud = Cloud(frame, T0, points, np.arange(len(points)) * 1000)
    with new_map(values) as rough_map:
        prepared = place_cloud(rough_map, "rover", cloud, poses, settings)
    if (rules, frame) == (2, "lidar"):
        assert prepared.rejected == {PointReason.DUPLICATE_RETURN: 1000, PointReason.NO_RETURN: 5}
        assert prepared.accepted == 500
        with new_map(values) as rough_map:
            alone = Cloud(frame, T0, ground, np.delete(cloud.offsets_ns, np.r_[200:1200, 1500:1505]))  # type: ignore[arg-type]
            rough_map.integrate(place_cloud(rough_map, "rover", alone, poses, settings))
            expected = rough_map.digest()
        with new_map(values) as rough_map:
            rough_map.integrate(place_cloud(rough_map, "rover", cloud, poses, settings))
            assert rough_map.digest() == expected
    else:
        assert PointReason.DUPLICATE_RETURN not in prepared.rejected
        assert prepared.accepted >= 1500
