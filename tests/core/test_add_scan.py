"""`add_scan` equals `georeference` followed by `add`, to the bit."""

import tracemalloc
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from properties import examples
from strategies import MODELS, SECOND_NS, START_NS, limits, noises, scans, state_of, trajectories

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory, georeference
from roughmap.cell import REASON_NAMES
from roughmap.settings import SURFACES


def both_ways(
    scan: Scan, way: Trajectory, noise: Noise, rules: Limits, model: str, surface: str, threads: int = 1
) -> tuple[RoughMap, RoughMap]:
    """Return maps of the scan by `add_scan` and by the two steps, after comparing their reports."""
    bounds = None
    if len(way.position):
        x, y = way.position[0, :2]
        bounds = (x - 5.0, y - 4.0, x + 4.0, y + 5.0)
    fused, stepped = (RoughMap(error_model=model, bounds=bounds, threads=threads, surface=surface) for _ in range(2))
    report = fused.add_scan(scan, way, noise, rules)
    placed = georeference(scan, way, noise, rules)
    reason, kept = placed.reason, placed.reason == 0
    offsets = 0 if scan.offsets_ns is None else scan.offsets_ns[kept]
    stamps = np.broadcast_to(scan.stamp_ns + offsets, (int(kept.sum()),))
    expected = stepped.add(
        placed.points[kept], placed.covariance[kept], stamps, common=placed.common[kept], mount=placed.mount[kept],
        up=placed.up[kept], pose_error_time=noise.pose_error_time,
    )  # fmt: skip
    early = Counter(REASON_NAMES[n] for n in reason[~kept].tolist())
    assert report.accepted == expected.accepted
    assert report.rejected == {**early, **expected.rejected}
    np.testing.assert_array_equal(report.tiles, expected.tiles)
    return fused, stepped


@examples(200)
@given(
    scan=scans(), way=trajectories(), noise=noises, rules=limits, model=st.sampled_from(MODELS),
    surface=st.sampled_from(SURFACES),
)  # fmt: skip
def test_any_scan(scan: Scan, way: Trajectory, noise: Noise, rules: Limits, model: str, surface: str) -> None:
    fused, stepped = both_ways(scan, way, noise, rules, model, surface)
    assert state_of(fused) == state_of(stepped)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("surface", SURFACES)
def test_a_whole_sweep(surface: str, model: str, moving: bool, dtype: type) -> None:
    """Many blocks and two threads in `add_scan`, against the two steps."""
    rng = np.random.default_rng(9)
    points = rng.normal(0, 4.0, (15_000, 3)).astype(dtype)
    points[::50] = 0.0
    stamps = START_NS + np.arange(12) * (SECOND_NS // 10)
    rotation = np.array([0.0, 0.0, 0.3, 0.9]) + rng.normal(0, 0.05, (12, 4))
    factor = rng.normal(0, 0.01, (12, 6, 6))
    way = Trajectory(stamps, rng.normal(0, 0.1, (12, 3)) + 5e5, rotation, factor @ factor.swapaxes(1, 2))
    offsets = rng.integers(-SECOND_NS // 100, SECOND_NS, 15_000) if moving else None
    scan = Scan(points, START_NS, offsets, (0.3, 0.1, 1.0), (0.1, 0.0, 0.7, 0.7))
    rules = Limits(min_range=0.8, ceiling=4.0, exclude=((-1.0, -0.5, -1.0, 1.0, 0.5, 1.5),))
    noise = Noise(0.02, 0.001, 0.002, (0.01, 0.01, 0.01, 0.001, 0.001, 0.002))
    fused, stepped = both_ways(scan, way, noise, rules, model, surface, threads=2)
    assert state_of(fused) == state_of(stepped)
    fused.close()
    stepped.close()


def test_no_covariance_array_in_between() -> None:
    """200,000 covariances would take 14.4 MB as (N, 3, 3), 9.6 MB as triangles.

    The planes take about 20 MB and are reused: after the first call almost nothing grows with the scan.
    """
    rng = np.random.default_rng(10)
    scan = Scan(rng.normal(0, 4.0, (200_000, 3)), START_NS)
    way = Trajectory([START_NS], [(0, 0, 0)], [(0, 0, 0, 1)], np.eye(6)[None] * 1e-6)
    m = RoughMap(error_model="cuboid", threads=1)
    m.add_scan(scan, way, Noise(0.01))
    tracemalloc.start()
    m.add_scan(scan, way, Noise(0.01))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4_000_000
