"""The same points in the same order give the same bytes, for any division into calls and any number of threads."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import MODELS, SECOND_NS, START_NS, clouds, random_axes, state_of, turned

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory


@settings(deadline=None, max_examples=100)
@given(
    cloud=clouds(most=80),
    model=st.sampled_from(MODELS),
    cell_size=st.sampled_from([0.1, 1.0]),
    cuts=st.lists(st.integers(0, 80), max_size=5),
)
def test_cut_into_calls(
    cloud: tuple[np.ndarray, np.ndarray, np.ndarray], model: str, cell_size: float, cuts: list[int]
) -> None:
    points, S, stamps = cloud
    whole = RoughMap(cell_size=cell_size, error_model=model, threads=1)
    whole.add(points, S, stamps)
    cut = RoughMap(cell_size=cell_size, error_model=model, threads=1)
    for part in np.split(np.arange(len(points)), sorted(cuts)):
        cut.add(points[part], S[part], stamps[part])
    assert cut.digest() == whole.digest()
    assert cut.newest_updated == whole.newest_updated


def survey(number: int, seed: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points over about 30 tiles in random order, with covariances of any shape."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 8.0, (number, 3))
    points[rng.random(number) < 0.3] *= 0.01  # a third within one cell or two: long chains of updates
    S = turned(random_axes(rng, number), np.exp(rng.uniform(np.log(1e-3), np.log(0.15), (number, 3))))
    return points, S, START_NS + rng.integers(0, 10 * SECOND_NS, number)


@pytest.mark.parametrize("model", MODELS)
def test_blocks_calls_and_threads(model: str) -> None:
    """Enough points for two threads (and seven), for many blocks of the kernels, and for calls that cut blocks."""
    points, S, stamps = survey(20_000)
    digests = set()
    for threads, step in ((1, 20_000), (2, 20_000), (7, 20_000), (1, 257), (2, 4_999)):
        with RoughMap(error_model=model, threads=threads) as m:
            for start in range(0, len(points), step):
                part = slice(start, start + step)
                m.add(points[part], S[part], stamps[part])
            digests.add(m.digest())
    assert len(digests) == 1


@pytest.mark.parametrize("model", MODELS)
def test_threads_leave_the_same_state(model: str) -> None:
    """The whole state is compared: cells, stamps, sequences at all levels, and the report."""
    points, S, stamps = survey(12_000)
    states = []
    for threads in (1, 2):
        with RoughMap(error_model=model, threads=threads, bounds=(-9, -7, 6.5, 8)) as m:
            reports = [m.add(points[part], S[part], stamps[part]) for part in (slice(0, 9_000), slice(9_000, None))]
            states.append((state_of(m), [(r.accepted, r.rejected, r.tiles.tolist()) for r in reports]))
    assert states[0] == states[1]


def test_other_points_before_do_not_matter_to_a_tile() -> None:
    """Tiles are independent: each has the same bytes if tiles come in another order or more tiles are present."""
    points, _, stamps = survey(3_000)
    tile = np.floor(points[:, :2] / 0.1).astype(int) >> 6
    order = np.lexsort((np.arange(3_000), -tile[:, 0], tile[:, 1] % 3))
    first, second = (RoughMap(error_model="point", threads=1) for _ in range(2))
    first.add(points, stamp_ns=stamps)
    for one in order:
        second.add(points[one : one + 1], stamp_ns=stamps[one : one + 1])
    assert first.digest() == second.digest()


def test_one_covariance_for_all_is_that_of_each() -> None:
    points, S, stamps = survey(1_000)
    for model in MODELS:
        alike, each = (RoughMap(error_model=model, threads=1) for _ in range(2))
        alike.add(points, S[0], stamps)
        each.add(points, np.tile(S[0], (1_000, 1, 1)), stamps)
        assert alike.digest() == each.digest()


def test_strides_and_kinds_of_numbers_do_not_matter() -> None:
    """The same values give the same bytes as columns of a wider array, reversed, big-endian, float32 or integers."""
    rng = np.random.default_rng(7)
    values = rng.integers(-40, 40, (500, 3))
    S = np.eye(3) * 0.0625
    m = RoughMap(threads=1)
    m.add(values.astype(np.float64), S)
    wide = np.full((500, 7), np.nan)
    wide[:, 1:6:2] = values
    backwards = np.ascontiguousarray(values[::-1].astype(np.float32))[::-1]
    for given_ in (values, wide[:, 1:6:2], backwards, values.astype(">f8"), values.tolist(), values.astype(np.float16)):
        other = RoughMap(threads=1)
        other.add(given_, S.astype(np.float32))
        assert other.digest() == m.digest()


def driven(model: str, threads: int, step: int, moving: bool) -> str:
    """Return the digest of a sweep of 20,000 returns over ten poses, added in parts."""
    rng = np.random.default_rng(8)
    stamps = START_NS + np.arange(11) * (SECOND_NS // 10)
    rotation = np.array([0.0, 0.0, 0.0, 1.0]) + rng.normal(0, 0.05, (11, 4))
    way = Trajectory(
        stamps, np.cumsum(rng.normal(0, 0.1, (11, 3)), axis=0), rotation, np.tile(np.eye(6), (11, 1, 1)) * 1e-5
    )
    points = rng.normal(0, 5.0, (20_000, 3)).astype(np.float32)
    offsets = np.sort(rng.integers(0, SECOND_NS, 20_000))
    with RoughMap(error_model=model, threads=threads) as m:
        for start in range(0, 20_000, step):
            part = slice(start, start + step)
            scan = Scan(points[part], START_NS, offsets[part] if moving else None, translation=(0.2, 0, 1))
            m.add_scan(scan, way, Noise(0.02, 0.0, 0.001), Limits(min_range=1.0))
        return m.digest()


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_scans_in_parts_and_by_threads(model: str, moving: bool) -> None:
    assert len({driven(model, *how, moving) for how in ((1, 20_000), (2, 20_000), (1, 333), (2, 7_777))}) == 1
