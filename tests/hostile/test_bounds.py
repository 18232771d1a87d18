"""Bounds that the configuration sets, at small values."""

from pathlib import Path

from processes import LEVEL, T0, running

from roughmap_client.asking import ask
from roughmap_schemas import QueryError, encode_odometry
from roughmap_service.counters import Counters
from roughmap_service.intake import InputMessage, Intake
from roughmap_service.log_file import Kind

S = 10**9


def test_poses_that_wait_to_be_taken_up() -> None:
    """Beyond the limit they are busy; once those before them are taken, there is room again."""
    counters = Counters()
    intake = Intake(1000, counters, pose_limit=3)

    def put(number: int) -> None:
        intake.put(InputMessage(Kind.ODOMETRY, "rover", b"%d" % number, 0, 0.0))

    for number in range(5):
        put(number)
    assert counters.snapshot().refused == {"busy": 2}
    assert [message.payload for message in intake.take(0.0)[0]] == [b"0", b"1", b"2"]
    put(5)
    assert [message.payload for message in intake.take(0.0)[0]] == [b"5"]
    assert counters.snapshot().refused == {"busy": 2}


def test_robots_and_poses(tmp_path: Path) -> None:
    """One robot more than may be heard is refused by the setting's name; of poses the newest are kept."""
    with running(tmp_path, input={"max_robots": 2, "max_poses": 4, "max_wait": 0.1}) as (_, feed):
        for number in range(6):
            feed.pose("rover", T0 + number * S // 10)
        key, payload = "maps/site/ingest/third/odometry", encode_odometry(T0, "map", (0, 0, 0), LEVEL)
        (error,) = ask(feed.session, key, timeout=30.0, payload=payload).errors
        refusal = QueryError.model_validate_json(error[0])
        assert refusal.code == "unknown_robot"
        assert "2 robots" in refusal.message
        assert "input.max_robots" in refusal.message
        assert feed.decided(feed.cloud("rover", T0 + S // 20)).outcome == "late", "its poses had to go"
        assert feed.decided(feed.cloud("rover", T0 + 9 * S // 20)).outcome == "integrated"
