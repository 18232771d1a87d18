"""The ground map against its oracle, byte by byte: all error models, hostile heights, any cutting, several threads."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from ground_records import check
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap.map import RoughMap
from roughmap.points.footprint import ERROR_MODELS
from roughmap.reference.ground import GroundOracle

SECOND = 1_000_000_000

PLACES = [(0.0, 0.0), (6.4, -6.4), (-12.83, 3.0), (1000.0, 6.35)]
"""Metres: within a tile, on a corner of four, beside an edge."""

FIRST_NS = 4_294_960 * SECOND
"""Milliseconds wrap at 4,294,967 s."""

LEVEL = [10.0, 10.03, 10.1]
"""Heights within one band."""

ROUGH = [*LEVEL, 10.3, 10.45, 9.7, 9.1, 8.8, 11.0, 12.1, 12.8, 13.4, 7.4, 5.0, -20.0, 900.0]
"""Heights in, below and above the bins of the ground at 10 m, on the borders of nibbles and beside them."""


class Cloud(NamedTuple):
    """Points with all that `add` takes of each."""

    points: np.ndarray
    covariance: np.ndarray
    stamp_ns: np.ndarray
    common: np.ndarray
    mount: np.ndarray
    up: np.ndarray


class Recipe(NamedTuple):
    """How to make a cloud: a few numbers, which are told when a test fails."""

    seed: int
    number: int
    levels: int
    place: tuple[float, float]
    spread: float
    widest: float
    pace: int
    up: float
    sure: float

    def cloud(self, heights: list[float]) -> Cloud:
        """Return points on a few cells, nine of ten at the same few heights: the fewer, the more often they win."""
        rng, number = np.random.default_rng(self.seed), self.number
        usual = rng.choice(heights, self.levels)
        points = np.empty((number, 3))
        points[:, :2] = np.array(self.place) + rng.normal(0.0, self.spread, (number, 2))
        points[:, 2] = np.where(rng.random(number) < 0.9, rng.choice(usual, number), rng.choice(heights, number))
        points[rng.random(number) < self.sure, 2] = heights[0]
        points[:, 2] += rng.choice([0.0, 0.01, -0.02], number)
        turn, _ = np.linalg.qr(rng.normal(size=(number, 3, 3)))
        sigma = np.exp(rng.uniform(np.log(3e-4), np.log(self.widest), (number, 3)))
        covariance = np.einsum("nij,nj,nkj->nik", turn, sigma**2, turn)
        stamp_ns = FIRST_NS + self.pace * rng.integers(0, 50, number)
        common, mount = rng.choice([0.0, 1e-4, 0.01, -1e-9], (2, number))
        return Cloud(points, covariance, stamp_ns, common, mount, rng.random(number) < self.up)


RECIPES = st.builds(
    Recipe,
    seed=st.integers(0, 2**32 - 1),
    number=st.integers(1, 400),
    levels=st.integers(1, 5),
    place=st.sampled_from(PLACES),
    spread=st.sampled_from([0.02, 0.1, 0.3]),
    widest=st.sampled_from([0.01, 0.05, 0.2]),
    pace=st.sampled_from([0, 1_000_000, SECOND, 20 * SECOND]),
    up=st.sampled_from([0.0, 0.1, 0.5]),
    sure=st.sampled_from([0.0, 0.7]),
)

CHOICES = st.fixed_dictionaries(
    {
        "cell_size": st.sampled_from([0.1, 0.25, 0.5]),
        "min_share": st.sampled_from([0.05, 0.0, 0.4]),
        "min_radius": st.sampled_from([1e-3, 0.02]),
        "bounds": st.sampled_from([None, (-0.27, -6.6, 6.45, 3.1)]),
    }
)
"""Settings of a map. The bounds cut through the first three places."""


@pytest.mark.parametrize("model", ERROR_MODELS)
@examples(60)
@given(recipe=RECIPES, chosen=CHOICES)
def test_level_ground_is_the_same_on_all_surfaces(model: str, recipe: Recipe, chosen: dict[str, Any]) -> None:
    """Where all heights are within the band, the ground is the paper's record of every point."""
    cloud = recipe.cloud(LEVEL)
    m = RoughMap(threads=1, surface="all", error_model=model, **chosen)
    report = m.add(cloud.points, cloud.covariance, cloud.stamp_ns, common=cloud.common, mount=cloud.mount)
    oracle = GroundOracle(m.settings)
    used = oracle.add(cloud.points, cloud.covariance, cloud.stamp_ns, common=cloud.common, mount=cloud.mount)
    assert used == report.accepted
    check(m, oracle)


@pytest.mark.parametrize("model", ERROR_MODELS)
@examples(150)
@given(
    recipe=RECIPES,
    chosen=CHOICES,
    time=st.sampled_from([5.0, 0.5, 30.0, 1e4]),
    cuts=st.lists(st.integers(0, 400), max_size=3),
)
def test_every_byte_is_as_the_oracle_says(
    model: str, recipe: Recipe, chosen: dict[str, Any], time: float, cuts: list[int]
) -> None:
    cloud = recipe.cloud(ROUGH)
    m = RoughMap(threads=1, surface="ground", error_model=model, **chosen)
    oracle = GroundOracle(m.settings)
    for part in np.split(np.arange(recipe.number), np.clip(sorted(cuts), 0, recipe.number)):
        points, covariance, stamp_ns, *rest = (values[part] for values in cloud)
        given_ = dict(zip(("common", "mount", "up"), rest, strict=True), pose_error_time=time)
        report = m.add(points, covariance, stamp_ns, **given_)
        assert oracle.add(points, covariance, stamp_ns, **given_) == report.accepted
    check(m, oracle)


@pytest.mark.parametrize("model", ERROR_MODELS)
@examples(40)
@given(recipe=RECIPES, chosen=CHOICES, common=st.sampled_from([None, 0.0, 1e-4]), mount=st.sampled_from([None, 1e-4]))
def test_one_value_for_all_points(
    model: str, recipe: Recipe, chosen: dict[str, Any], common: float | None, mount: float | None
) -> None:
    """Scans at rest: one stamp, one covariance, one variance for all points of a call."""
    cloud = recipe.cloud(ROUGH)
    m = RoughMap(threads=1, surface="ground", error_model=model, **chosen)
    oracle = GroundOracle(m.settings)
    for part in np.array_split(np.arange(recipe.number), 4):
        if len(part):
            points, S, stamp_ns = cloud.points[part], cloud.covariance[part[0]], int(cloud.stamp_ns[part[0]])
            report = m.add(points, S, stamp_ns, common=common, mount=mount)
            assert oracle.add(points, S, stamp_ns, common=common or 0.0, mount=mount or 0.0) == report.accepted
    check(m, oracle)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("model", ERROR_MODELS)
def test_many_points_on_several_threads(model: str, threads: int) -> None:
    """So many points that each thread has its part, on four tiles and on both sides of their edges."""
    recipe = Recipe(5, 12_000, 5, (6.4, -6.4), 0.5, 0.05, SECOND, 0.1, 0.3)
    cloud = recipe.cloud(ROUGH)
    with RoughMap(threads=threads, surface="ground", error_model=model) as m:
        oracle = GroundOracle(m.settings)
        given_ = {"common": cloud.common, "mount": cloud.mount, "up": cloud.up}
        m.add(cloud.points, cloud.covariance, cloud.stamp_ns, **given_)
        oracle.add(cloud.points, cloud.covariance, cloud.stamp_ns, **given_)
        assert m._space.parts(recipe.number) == threads
        check(m, oracle)


@pytest.mark.parametrize("model", ERROR_MODELS)
@pytest.mark.parametrize("drop", [1.9, 2.1])
def test_a_ground_that_has_crept_up(model: str, drop: float) -> None:
    """The bins stay where they were, so that hits in them may lie more than 2 m below: three are enough there."""
    m = RoughMap(threads=1, surface="ground", error_model=model)
    oracle = GroundOracle(m.settings)
    S = np.eye(3) * 1e-4
    points: list[tuple[float, float, float]] = []

    def add(h: float) -> float:
        points.append((0.05, 0.05, h))
        oracle.add(np.array(points[-1:]), S)
        return oracle.cells[0, 0].mean

    mean = add(10.0)
    add(11.0)
    while mean < 11.05:
        mean = add(mean + 0.149)
    m.add(points, S)  # how they are cut into calls makes no difference
    for _ in range(3):
        add(mean - drop)
        m.add(points[-1:], S)
    assert (oracle.cells[0, 0].count == 1) == (drop > 2.0)
    check(m, oracle)
