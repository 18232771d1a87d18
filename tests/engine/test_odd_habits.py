"""What is odd about a robot's odometry though it is taken: told once in the log, and listed while it goes on.

Bursts are a problem: scans are placed by wrong times.
"""

import logging
import time
from pathlib import Path

import pytest
from service_tools import T0, LoggedRun, config

from roughmap_schemas import encode_odometry, encode_transform
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.odd_habits import Habits
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.poses import Pose
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import Settings

LEVEL = (0.0, 0.0, 0.0, 1.0)
NUMBER = 120


def regular(k: int) -> tuple[float, float]:
    """Second and y of a pose: 50 Hz, straight on."""
    return k * 0.02, 0.0


def bursts(k: int) -> tuple[float, float]:
    """Four poses a millisecond apart, every 0.24 s."""
    return k // 4 * 0.24 + k % 4 * 0.001, 0.0


def jitter(k: int) -> tuple[float, float]:
    """400 Hz, 2 cm from side to side."""
    return k * 0.0025, 0.02 * (k % 2)


@pytest.mark.parametrize(
    ("way", "frame", "ahead", "wanted"),
    [
        (regular, "map", 0, None),
        (regular, "odom", 0, None),
        (regular, "odom", 3600 * 10**9, "the transform to 'odom' is stamped 3,59"),
        (jitter, "map", 0, "its odometry jitters by 2.0 cm from pose to pose: it seems to move at 8 m/s"),
    ],
    ids=["nothing", "nothing of a transform", "later transform", "jitter"],
)
def test_it_is_told_once(
    way: object, frame: str, ahead: int, wanted: str | None, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with LoggedRun(tmp_path / "log") as run:
        if frame != "map":
            run.put(Kind.TRANSFORM, encode_transform(T0 + ahead, "map", frame, (0.0, 0.0, 0.0), LEVEL))
        for k in range(NUMBER):
            second, y = way(k)  # type: ignore[operator]
            stamp_ns = T0 + round(second * 1e9)
            run.put(Kind.ODOMETRY, encode_odometry(stamp_ns, frame, (0.2 * second, y, 0.0), LEVEL))
        told = [text for text in run.streams.recent.told() if "covariance" not in text]
        lines = [record.getMessage() for record in caplog.records if getattr(record, "event", "") == "habit"]
        assert run.counters.snapshot().poses_accepted == NUMBER, "all are taken"
    if wanted is None:
        assert (told, lines) == ([], [])
    else:
        (line,) = lines
        assert line.startswith(f"robot rover: {wanted}")
        assert told == [f"{line} (0 s ago)"]


def turns(k: int) -> tuple[float, float]:
    """Two sources of 25 Hz that take turns, 1.5 ms apart, each with the right stamps."""
    return k // 2 * 0.04 + k % 2 * 0.0015, 0.0


@pytest.mark.parametrize(("way", "number"), [(bursts, 4), (turns, 0), (regular, 0)], ids=["bursts", "turns", "none"])
def test_bursts_are_a_problem_while_they_last(way: object, number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: now)
    settings = Settings(config())
    robot = Robot(settings, "r1")
    streams = Streams(settings.config, lambda: now)
    habits = Habits(streams, {"r1": robot})
    seen = []
    for k in range(3000):
        as_wanted = way if k < 1500 else regular
        second, y = as_wanted(k)  # type: ignore[operator]
        second += 1000.0 if k >= 1500 else 0.0
        now = 100.0 + second
        robot.buffer.insert(Pose(T0 + round(second * 1e9), (0.2 * second, y, 0.0), LEVEL, None, k + 1, 0))
        robot.buffer.trim()
        streams.pose("r1", None)
        habits.look("r1", "map")
        text = streams.problems().get("robot r1", "")
        if not seen or seen[-1] != text:
            seen.append(text)
    if not number:
        assert seen == [""]
        return
    before, told, after = seen
    assert (before, after) == ("", "")
    assert told.startswith(f"robot r1: its odometry is stamped in bursts: about {number} poses 1.0 ms apart, then none")
