"""The inhabited world: what the scanner sees of it is there, and the rover's way is clear."""

import dataclasses

import numpy as np
import pytest

from roughmap_service.simulation.rover import MOUNT, Rover
from roughmap_service.simulation.scanner import Scanner
from roughmap_service.simulation.solids import Solids, extent
from roughmap_service.simulation.truth import Why, truth
from roughmap_service.simulation.world import CYCLE_S, MOVERS, NO_PUDDLE, RAIN, World, bare, inhabited

EXACT = Scanner(columns=256, range_sigma=0.0, beam_sigma=0.0)


@pytest.fixture(scope="module")
def world() -> World:
    return inhabited(2)


def sweep(world: World, seconds: float, scanner: Scanner = EXACT) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A sweep from where the rover is then, standing still: points in the map (N, 3), the sensor, which came back."""
    pose = Rover(world, start_ns=0).pose(np.array([round(seconds * 1e9)]))
    sensor = pose.position[0] + pose.rotation[0] @ np.asarray(MOUNT)
    still = np.repeat(pose.rotation, scanner.columns, axis=0)
    rng = np.random.default_rng(round(seconds * 10))
    seen, _ = scanner.sweep(world, seconds, np.tile(sensor, (scanner.columns, 1)), still, rng)
    return sensor + seen.astype(np.float64) @ pose.rotation[0].T, sensor, (seen != 0).any(axis=1)


def within(solids: Solids, index: int, points: np.ndarray) -> np.ndarray:
    """Which points are in a solid or within a millimetre of it: the scanner's points are float32."""
    grown = solids.copy()
    for half in ("half_x", "half_y", "half_z"):
        grown[half] += 1e-3
    one = grown[index]
    low, high = extent(grown, index, points[:, 0] - one["x"], points[:, 1] - one["y"])
    return (points[:, 2] >= low) & (points[:, 2] <= high)


def on_ground(world: World, points: np.ndarray) -> np.ndarray:
    """Which points lie on the ground: to a millimetre in height or, on the walls and kerbs, sideways."""
    heights = [
        world.ground.height(points[:, 0] + dx, points[:, 1] + dy) for dx in (-1e-3, 0, 1e-3) for dy in (-1e-3, 0, 1e-3)
    ]
    return (points[:, 2] >= np.min(heights, axis=0) - 1e-3) & (points[:, 2] <= np.max(heights, axis=0) + 1e-3)


@pytest.mark.parametrize("seconds", [1.0, 4.0, 7.0, 12.0, 19.0, 25.0, 30.0])
def test_every_return_lies_on_the_ground_or_on_something(world: World, seconds: float) -> None:
    dry = dataclasses.replace(world, puddle=NO_PUDDLE, rain=0.0)
    points, _, back = sweep(dry, seconds)
    points = points[back]
    explained = on_ground(dry, points)
    solids = dry.solids(seconds)
    for k in range(solids.size):
        explained |= within(solids, k, points)
    assert explained.all(), points[~explained]


def test_all_that_is_built_and_grows_is_seen_on_the_way(world: World) -> None:
    dry = dataclasses.replace(world, puddle=NO_PUDDLE, rain=0.0, movers=())
    points = np.concatenate([sweep(dry, seconds)[0] for seconds in np.arange(0.0, 36.0, 2.0)])
    seen = [int(within(dry.fixed, k, points).sum()) for k in range(dry.fixed.size)]
    # One or the other trunk or tuft may be hidden behind others.
    assert np.mean(np.asarray(seen) > 10) > 0.95


def test_the_puddle_mirrors_what_is_stands_behind_it_to_below_the_ground(world: World) -> None:
    dry = dataclasses.replace(world, rain=0.0, movers=())
    ghosts = 0
    for seconds in (1.0, 2.0, 2.5, 17.5):
        points, sensor, back = sweep(dry, seconds, dataclasses.replace(EXACT, columns=1024))
        points = points[back]
        at_wall = (np.abs(points[:, 0] - 1.5) < 4.0) & (points[:, 1] > 8.5) & (points[:, 1] < 9.1)
        below = points[at_wall & (points[:, 2] < world.ground.height(points[:, 0], 8.3) - 0.1)]
        ghosts += len(below)
        x, y, half_x, half_y = world.puddle
        water = world.ground.height(x, y)
        share = (water - sensor[2]) / (below[:, 2] - sensor[2])
        crossing = sensor + share[:, None] * (below - sensor)
        # A millimetre more than the ellipse, for points in float32.
        assert np.all(np.hypot((crossing[:, 0] - x) / half_x, (crossing[:, 1] - y) / half_y) < 1.001)
    assert ghosts > 100


def test_rain_is_a_thousandth_of_all_beams() -> None:
    dry = bare(2)
    wet = dataclasses.replace(dry, rain=RAIN)
    drops = beams = 0
    for seconds in range(12):
        (seen, sensor, back), (rainy, _, rainy_back) = sweep(dry, seconds), sweep(wet, seconds)
        other = (seen != rainy).any(axis=1)
        drops, beams = drops + int(other.sum()), beams + other.size
        assert rainy_back[other].all()
        # A drop is on the beam's way, before its end.
        assert np.all(
            np.linalg.norm(rainy - sensor, axis=1)[other & back] <= np.linalg.norm(seen - sensor, axis=1)[other & back]
        )
    # 196,608 beams: 197 drops, with a spread of 14; the seed is fixed.
    assert abs(drops - RAIN * beams) < 60


def test_they_walk_stand_and_leave_and_begin_again(world: World) -> None:
    walker, stander, car = ([(x, y) for _, x, y in mover.way] for mover in MOVERS)

    def where(seconds: float) -> set[tuple[float, float]]:
        moving = world.solids(seconds)[world.fixed.size :]
        return {(round(float(x), 2), round(float(y), 2)) for x, y in zip(moving["x"], moving["y"], strict=True)}

    assert walker[0] in where(0.0)
    assert stander[0] in where(19.9)
    assert stander[0] not in where(20.5)
    assert car[0] not in where(23.0)
    assert not where(50.0)
    assert where(CYCLE_S + 5.0) == where(5.0)


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_stands_or_hangs_in_the_rover_s_way(seed: int) -> None:
    world = inhabited(seed)
    rover = Rover(world, start_ns=0)
    for seconds in np.arange(0.0, CYCLE_S, 0.5):
        place = rover.pose(np.array([round(seconds * 1e9)])).position[0, :2]
        around = truth(world, seconds, (place[0] - 0.6, place[1] - 0.6), 0.1, (12, 12))
        assert not (around.why == Why.OBJECT).any(), (seconds, place)
