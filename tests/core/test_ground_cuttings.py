"""A map of the ground has the same bytes for any division into calls and any number of threads, and so have tiles that
points which can't be ground touch before they exist."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, SECOND_NS, START_NS, covariances, random_axes, seeds, state_of, turned

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory

HEIGHTS = np.array([0.0, 0.02, -0.03, 0.1, 0.17, -0.4, -0.9, -1.3, -4.0, 0.6, 1.1, 2.4, 2.95, 3.05, 9.0])
"""Ground, what stands and hangs over it, pits, strays; around the edges of the band and of the column."""

Points = dict[str, Any]
"""Arguments of `RoughMap.add`, (N, ...) each."""


def part_of(points: Points, part: Any) -> Points:
    """The arguments for some of the points."""
    return {name: values[part] for name, values in points.items()}


def told(rng: np.random.Generator, heights: np.ndarray, spread: float, pace: int) -> Points:
    """All but the covariances: points at these heights, some that can't be ground, with errors of all sizes."""
    number = len(heights)
    where = np.column_stack([rng.normal(0, spread, (number, 2)), heights + rng.normal(0, 0.01, number)])
    return {
        "points": where,
        "stamp_ns": START_NS + rng.integers(0, 60, number) * pace,
        "common": rng.choice([0.0, 1e-5, 4e-3, -1e-12, np.inf], number),
        "mount": rng.choice([0.0, 2e-4], number),
        "up": rng.random(number) < rng.choice([0.0, 0.3, 0.9]),
    }


@st.composite
def scenes(draw: st.DrawFn) -> Points:
    """Up to 150 points at few heights, most at one or two, in a few cells on the corner of four tiles."""
    number = draw(st.integers(1, 150))
    rng = np.random.default_rng(draw(seeds))
    usual = rng.choice(HEIGHTS, draw(st.integers(1, 3)))
    heights = np.where(rng.random(number) < 0.8, rng.choice(usual, number), rng.choice(HEIGHTS, number))
    pace = draw(st.sampled_from([0, 1_000_000, SECOND_NS]))
    scene = told(rng, heights, draw(st.sampled_from([0.03, 0.2])), pace)
    return {**scene, "covariance": draw(covariances(number, 5e-3))}


@examples(150)
@given(
    scene=scenes(),
    model=st.sampled_from(MODELS),
    cell_size=st.sampled_from([0.1, 0.5]),
    cuts=st.lists(st.integers(0, 150), max_size=5),
    bounds=st.sampled_from([None, (-0.21, -0.13, 0.14, 0.3)]),
)
def test_cut_into_calls(scene: Points, model: str, cell_size: float, cuts: list[int], bounds: Any) -> None:
    rules: dict[str, Any] = {"surface": "ground", "error_model": model, "cell_size": cell_size, "bounds": bounds}
    whole, cut = RoughMap(threads=1, **rules), RoughMap(threads=1, **rules)
    accepted = whole.add(**scene).accepted
    number = len(scene["points"])
    parts = np.split(np.arange(number), sorted(min(k, number) for k in cuts))
    assert sum(cut.add(**part_of(scene, part)).accepted for part in parts) == accepted
    assert cut.digest() == whole.digest()
    assert cut.newest_updated == whole.newest_updated
    stamps = []
    for m in (whole, cut):
        with m.freeze() as frozen:
            stamps.append({(x, y): frozen.stamps(x, y) for x, y in frozen.tiles.tolist()})
    assert stamps[0] == stamps[1]


def survey(number: int) -> Points:
    """Points over about 30 tiles in random order: ground, walls, a ceiling; a third within one cell or two."""
    rng = np.random.default_rng(11)
    survey = told(rng, rng.choice(HEIGHTS, number), 8.0, SECOND_NS)
    survey["points"][rng.random(number) < 0.3, :2] *= 0.01
    survey["points"][:, 2] += 0.02 * survey["points"][:, 0]
    sigma = np.exp(rng.uniform(np.log(1e-3), np.log(0.15), (number, 3)))
    return {**survey, "covariance": turned(random_axes(rng, number), sigma)}


@pytest.mark.parametrize("model", MODELS)
def test_blocks_calls_and_threads(model: str) -> None:
    scene = survey(20_000)
    digests = set()
    for threads, step in ((1, 20_000), (2, 20_000), (7, 20_000), (1, 257), (2, 4_999)):
        with RoughMap(error_model=model, threads=threads, surface="ground") as m:
            for start in range(0, 20_000, step):
                m.add(**part_of(scene, slice(start, start + step)))
            digests.add(m.digest())
    assert len(digests) == 1


@pytest.mark.parametrize("model", MODELS)
def test_threads_leave_the_same_state(model: str) -> None:
    scene = survey(12_000)
    states = []
    for threads in (1, 2):
        with RoughMap(error_model=model, threads=threads, bounds=(-9, -7, 6.5, 8), surface="ground") as m:
            reports = [m.add(**part_of(scene, part)) for part in (slice(0, 9_000), slice(9_000, None))]
            states.append((state_of(m), [(r.accepted, r.rejected, r.tiles.tolist()) for r in reports]))
    assert states[0] == states[1]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_scans_in_parts_and_by_threads(model: str, moving: bool) -> None:
    """A sweep in a hall with a ceiling over ten poses, which are uncertain and so is the mounting."""
    rng = np.random.default_rng(12)
    stamps = START_NS + np.arange(11) * (SECOND_NS // 10)
    rotation = np.array([0.0, 0.0, 0.0, 1.0]) + rng.normal(0, 0.02, (11, 4))
    way = Trajectory(stamps, rng.normal(0, 0.1, (11, 3)), rotation, np.tile(np.eye(6), (11, 1, 1)) * 1e-5)
    points = rng.uniform(-6.0, 6.0, (20_000, 3)).astype(np.float32)
    points[:, 2] = rng.choice([-1.0, -0.6, 0.2, 2.5], 20_000)
    offsets = np.sort(rng.integers(0, SECOND_NS, 20_000))
    noise = Noise(0.02, 0.0, 0.001, (0.01, 0.01, 0.01, 0.001, 0.001, 0.002), pose_error_time=0.3)
    digests = set()
    for threads, step in ((1, 20_000), (2, 20_000), (1, 333), (2, 7_777)):
        with RoughMap(error_model=model, threads=threads, surface="ground") as m:
            for start in range(0, 20_000, step):
                part = slice(start, start + step)
                scan = Scan(points[part], START_NS, offsets[part] if moving else None, translation=(0.2, 0, 1))
                m.add_scan(scan, way, noise, Limits(min_range=1.0))
            digests.add(m.digest())
    assert len(digests) == 1


def one(x: float, h: float, second: int, **more: Any) -> Points:
    """One point in the row of cells y = 0.05."""
    return {"points": [(x, 0.05, h)], "stamp_ns": second * SECOND_NS, **more}


def seen(m: RoughMap, x: int = 0) -> tuple[int, int] | None:
    """The stamps of tile (x, 0) in seconds, None if it does not exist."""
    with m.freeze() as frozen:
        if [x, 0] not in frozen.tiles.tolist():
            return None
        oldest, newest = frozen.stamps(x, 0)
        return oldest // SECOND_NS, newest // SECOND_NS


def test_points_that_look_up_make_no_tile() -> None:
    m = RoughMap(error_model="point", surface="ground", threads=1)
    report = m.add(**one(0.05, 2.0, 5, up=True))
    assert (report.accepted, report.tiles.tolist(), m.tile_count, m.newest_updated) == (1, [], 0, 0)
    m.add(**one(0.05, 0.0, 6))
    assert seen(m) == (6, 6)
    report = m.add(**one(6.35, 2.0, 9, up=True))  # where the tile knows no cell
    assert report.tiles.tolist() == [[0, 0]]
    assert (seen(m), m.newest_updated) == ((6, 9), 9)


def test_in_one_call_a_tile_begins_with_its_first_point_that_can_be_ground() -> None:
    m = RoughMap(error_model="point", surface="ground", threads=1)
    points = [(0.05, 0.05, 2.0), (6.45, 0.05, 2.0), (0.05, 0.05, 0.0), (0.05, 0.05, 2.0)]
    report = m.add(points, stamp_ns=np.array([1, 2, 5, 9]) * SECOND_NS, up=np.array([True, True, False, True]))
    assert (report.accepted, report.tiles.tolist()) == (4, [[0, 0]])
    assert (seen(m), seen(m, 1)) == ((5, 9), None)
    wide = RoughMap(error_model="cuboid", surface="ground", threads=1)
    points = [(6.4, 0.05, 2.0), (6.4, 0.05, 0.0), (6.4, 0.05, 2.0)]  # each in both tiles
    wide.add(points, np.eye(3) * 1e-4, np.array([1, 5, 9]) * SECOND_NS, up=np.array([True, False, True]))
    assert (seen(wide), seen(wide, 1)) == ((5, 9), (5, 9))


def test_limits_count_only_tiles_that_would_be_made() -> None:
    m = RoughMap(error_model="point", surface="ground", threads=1)
    points = [(0.05, 0.05, 2.0), (6.45, 0.05, 0.0)]
    report = m.add(points, up=np.array([True, False]), max_new_tiles=1, max_tiles=1)
    assert report.tiles.tolist() == [[1, 0]]


def test_columns_exist_only_where_a_cell_has_one() -> None:
    m = RoughMap(error_model="point", surface="ground", threads=1)
    m.add(**one(0.05, 0.0, 1))
    flat = m.memory_bytes
    m.add(**one(0.05, 0.01, 2))
    assert m.memory_bytes == flat
    m.add(**one(0.05, 1.0, 3))
    assert m.memory_bytes == flat + 4096 * 64
