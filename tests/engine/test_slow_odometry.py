"""What is told of clouds whose poses come too seldom."""

from pathlib import Path

import pytest
from service_tools import LoggedRun, cloud, odometry

from roughmap_schemas.kinds import Kind

SUBJECT = "robot rover sensor lidar"


@pytest.mark.parametrize("period", [0.55, 0.8])
def test_poses_too_far_apart_are_named_and_not_a_clock_or_an_end(period: float, tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as live:
        for k in range(21):
            live.put(Kind.ODOMETRY, odometry(k * 0.05))
        poses = 0
        for k in range(1, 20):
            now = 1.0 + k * 0.1
            while (poses + 1) * period <= k * 0.1:
                poses += 1
                live.put(Kind.ODOMETRY, odometry(1.0 + poses * period))
            live.put(Kind.POINTS, cloud(now))
            live.decide(1.0)
        told = live.streams.problems()[SUBJECT]
    assert f"the robot's poses are {period:.2g} s apart (input.max_pose_gap = 0.5)" in told
    assert told.endswith("publish poses more often, or raise input.max_pose_gap and input.max_wait")


def test_one_wild_stamp_is_no_slow_odometry(tmp_path: Path) -> None:
    with LoggedRun(tmp_path) as live:
        for k in range(20):
            live.put(Kind.ODOMETRY, odometry(k * 0.05))
        live.put(Kind.ODOMETRY, odometry(3600.0))
        for k in range(12):
            live.put(Kind.POINTS, cloud(1.0 + k * 0.1))
            live.decide(1.0)
        told = live.streams.problems()[SUBJECT]
    assert "apart" not in told
