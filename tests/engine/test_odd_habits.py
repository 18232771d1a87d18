"""What is odd about a robot's odometry though it is taken: told once in the log, and listed while it goes on."""

import logging
from pathlib import Path

import pytest
from service_tools import T0, LoggedRun

from roughmap_schemas import encode_odometry, encode_transform
from roughmap_schemas.kinds import Kind

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
        (bursts, "map", 0, "its odometry is stamped in bursts: about 4 poses 1.0 ms apart, then none for 0.24 s"),
        (jitter, "map", 0, "its odometry jitters by 2.0 cm from pose to pose: it seems to move at 8 m/s"),
    ],
    ids=["nothing", "nothing of a transform", "later transform", "bursts", "jitter"],
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
        told = {subject: text for subject, text in run.streams.recent.told().items() if "covariance" not in text}
        lines = [record.getMessage() for record in caplog.records if getattr(record, "event", "") == "habit"]
        assert run.counters.snapshot().poses_accepted == NUMBER, "all are taken"
    if wanted is None:
        assert (told, lines) == ({}, [])
    else:
        (line,) = lines
        assert line.startswith(f"robot rover: {wanted}")
        assert line in told["robot rover"]
