"""A loop driven twice by odometry that drifts, which nothing corrects: `map.keep` leaves no false steps beside it."""

from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from replay_tools import replay
from service_tools import SECOND, T0, LoggedRun, cloud, config

from roughmap.reading.layers import DEFAULT_LIMITS
from roughmap_schemas import encode_odometry
from roughmap_schemas.kinds import Kind

WAY = 200.0
"""Metres of one loop."""

ROUND = WAY / (2.0 * pi)
"""Radius of the loop, metres."""

SPEED = 2.0
DRIFT = 0.01
"""Error of the odometry after each metre driven, in height and in the plane, metres."""

MOUNTED = 1.0
"""Height of the robot's base, which is also the scanner, above the ground, metres."""

NEAR = 10.0
"""Metres around the robot that must be free of false steps."""

CELL = 0.2
STEP = DEFAULT_LIMITS["ground"]["step"]

PRECISE = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the true ground: waves of 0.3 m, at most 4.3 % steep."""
    return 0.3 * np.sin(x / 10.0) * np.cos(y / 14.0)


def place(s: float) -> tuple[float, float, float, float]:
    """Return where the robot truly is after ``s`` metres, x, y, z, and its heading."""
    turn = s / ROUND
    x, y = ROUND * cos(turn), ROUND * sin(turn)
    return x, y, float(height(np.array(x), np.array(y))) + MOUNTED, turn + pi / 2.0


def drifted(s: float, up: float) -> tuple[float, float, float]:
    """Return where the odometry says that it is."""
    x, y, z, _ = place(s)
    return x + 0.6 * DRIFT * s, y - 0.8 * DRIFT * s, z + up * DRIFT * s


def scan(s: float, seed: int) -> np.ndarray:
    """Return what the scanner sees of the ground, (N, 3) in its own frame: 36 rings up to 12 m, 1 cm of noise."""
    x, y, z, heading = place(s)
    rng = np.random.default_rng(seed)
    reach, angle = np.meshgrid(np.linspace(0.6, 12.0, 36), np.arange(0.0, 2.0 * pi, 2.0 * pi / 180))
    reach, angle = reach.ravel() + rng.uniform(-0.15, 0.15, reach.size), angle.ravel() + rng.uniform(-0.02, 0.02)
    # No ray is followed: from 1 m above it, all such ground within 12 m is seen.
    ahead, left = reach * np.cos(angle), reach * np.sin(angle)
    ground = height(x + ahead * cos(heading) - left * sin(heading), y + ahead * sin(heading) + left * cos(heading))
    return np.column_stack([ahead, left, ground - z + rng.normal(0.0, 0.01, reach.size)])


def false_steps(run: LoggedRun, s: float, up: float) -> tuple[int, int]:
    """Return how many cells within reach of the robot are forbidden or beside a step, and how many are known."""
    x, y, _ = drifted(s, up)
    region = run.run.map.region((x - NEAR, y - NEAR, x + NEAR, y + NEAR), ("step_height", "traversability"))
    rows, columns = (np.arange(number) + 0.5 for number in region["step_height"].shape)
    along_x, along_y = (region.origin[0] + columns * CELL - x, region.origin[1] + rows * CELL - y)
    near = np.hypot(along_x, along_y[:, None]) <= NEAR
    step, passable = region["step_height"][near], region["traversability"][near]
    return int(((step > STEP) | (passable == 0.0)).sum()), int(np.isfinite(step).sum())


def drive(run: LoggedRun, up: float, metres: float) -> list[tuple[int, int]]:
    """Drive the loop, then ``metres`` of it again, a scan a second; return `false_steps` of every 4 m of these."""
    seen = []
    for n in range(round((WAY + metres) / SPEED)):
        for quarter in range(4):
            s = (n + quarter / 4.0) * SPEED
            heading = place(s)[3]
            turned = (0.0, 0.0, sin(heading / 2.0), cos(heading / 2.0))
            stamp = T0 + (4 * n + quarter) * SECOND // 4
            run.put(Kind.ODOMETRY, encode_odometry(stamp, "map", drifted(s, up), turned, PRECISE))
        run.put(Kind.POINTS, cloud(n + 0.5, points=scan((n + 0.5) * SPEED, n)))
        assert [event.outcome for event in run.decide()] == ["integrated"]
        if n * SPEED >= WAY and n % 2 == 0:
            seen.append(false_steps(run, (n + 0.75) * SPEED, up))
    return seen


@pytest.mark.parametrize("up", [1.0, -1.0], ids=["up", "down"])
def test_no_false_step_beside_a_robot_that_forgets_what_it_left_behind(tmp_path: Path, up: float) -> None:
    logs = tmp_path / "log"
    with LoggedRun(logs, config(map={"cell_size": CELL, "keep": {"radius": 25.0}})) as run:
        seen = drive(run, up, WAY)
        assert run.counters.snapshot().tiles_forgotten > 20
        run.checkpoint()
    assert len(seen) == 50
    assert [false for false, _ in seen] == [0] * 50
    assert min(known for _, known in seen) > 0.9 * pi * (NEAR / CELL) ** 2
    code, said, _ = replay(logs)
    assert (code, said.split(":")[0]) == (0, "equal")


@pytest.mark.parametrize("up", [1.0, -1.0], ids=["up", "down"])
def test_without_forgetting_old_ground_becomes_false_steps(tmp_path: Path, up: float) -> None:
    """So the loop is one that shows them."""
    with LoggedRun(tmp_path / "log", config(map={"cell_size": CELL})) as run:
        assert min(false for false, _ in drive(run, up, 20.0)) > 1000
