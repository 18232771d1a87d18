"""Scans that clear against the oracle, byte by byte, and the number of halved hits."""

from typing import Any

import numpy as np
import pytest
from ground_records import check
from hypothesis import given
from hypothesis import strategies as st
from properties import examples

from roughmap import Limits, Noise, RoughMap, Scan, Trajectory, georeference
from roughmap.points.footprint import ERROR_MODELS
from roughmap.reference.ground import GroundOracle
from roughmap.reference.ground_clearing import clear_cells, range_image

SECOND = 1_000_000_000
NOISE = Noise(0.01, 0.001, 0.001)

LIMITS = [
    Limits(),
    Limits(min_range=1.0, max_range=8.0),
    Limits(ceiling=0.4, exclude=((-1.0, -1.0, -2.0, 2.0, 1.0, 2.0),)),
]
"""Returns that the map does not use say what was seen through, too."""


def returns(rng: np.random.Generator, rings: int, far: list[float]) -> np.ndarray:
    """Return what ``rings`` of 240 beams meet: floor 1.2 m below, else something at one of the distances ``far``."""
    turn = np.tile(np.arange(240) * np.pi / 120, rings) + rng.uniform(0.0, 0.02)
    rise = np.repeat(np.tan(np.radians(np.linspace(-40.0, 20.0, rings))), 240)
    sector = rng.choice(far, 24)[np.tile(np.arange(240) // 10, rings)]
    d = np.where(rise < 0.0, np.minimum(sector, 1.2 / np.maximum(-rise, 1e-9)), sector)
    points = np.column_stack([d * np.cos(turn), d * np.sin(turn), d * rise])
    return points[rng.random(len(points)) < 0.9]


@pytest.mark.parametrize("model", ERROR_MODELS)
@examples(6)
@given(
    seed=st.integers(0, 2**32 - 1),
    rings=st.sampled_from([5, 12]),
    limits=st.sampled_from(LIMITS),
    place=st.sampled_from([(0.03, -0.04, 0.0), (6.4, 12.8, 3.0), (-1000.0, 1000.05, -7.0)]),
    cell_size=st.sampled_from([0.1, 0.2]),
)
def test_every_byte_is_as_the_oracle_says(
    model: str, seed: int, rings: int, limits: Limits, place: tuple[float, float, float], cell_size: float
) -> None:
    """A sensor at the robot's origin, which stands and turns."""
    rng = np.random.default_rng(seed)
    m = RoughMap(cell_size=cell_size, error_model=model, threads=1, surface="ground")
    oracle = GroundOracle(m.settings)
    cleared = 0
    for k in range(4):
        yaw = rng.uniform(0.0, np.pi)
        stamp = (10 + 2 * k) * SECOND
        trajectory = Trajectory(
            np.array([stamp - SECOND, stamp + SECOND]), np.array([place, place]) + np.array([0.1 * k, 0.0, 0.0]),
            np.tile([0.0, 0.0, np.sin(yaw), np.cos(yaw)], (2, 1)), np.tile(np.eye(6) * 1e-5, (2, 1, 1)),
        )  # fmt: skip
        scan = Scan(returns(rng, rings, [1.0, 2.5, 4.0, 6.0, 11.0] if k < 2 else [2.8, 7.0, 12.0]), stamp)
        report = m.add_scan(scan, trajectory, NOISE, limits, clear=True)
        halved = follow(oracle, scan, trajectory, limits)
        assert report.cleared == halved
        cleared += halved
    check(m, oracle)
    assert cleared


def follow(oracle: GroundOracle, scan: Scan, trajectory: Trajectory, limits: Limits) -> int:
    """Give the oracle a scan that clears; return how many hits it halved."""
    placed, everywhere = (georeference(scan, trajectory, NOISE, which) for which in (limits, Limits()))
    given_: dict[str, Any] = {"common": placed.common, "mount": placed.mount, "up": placed.up}
    oracle.add(placed.points, placed.covariance, scan.stamp_ns, **given_)
    if not (placed.reason == 0).any():
        return 0
    x, y, z = np.ascontiguousarray(everywhere.points.T)
    px, py, pz = trajectory.position[0].tolist()
    image = range_image(x, y, z, placed.reason, (px, py, pz))
    return clear_cells(oracle.cells, image, (px, py, pz), oracle.settings.cell_size)
