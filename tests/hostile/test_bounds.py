"""Bounds that the configuration sets, at small values."""

from pathlib import Path

import pytest
from net import WAIT_S
from processes import LEVEL, T0, Service, connected, read_log, running

from roughmap_client.session import ask
from roughmap_schemas import QueryError, encode_odometry
from roughmap_schemas.kinds import Kind
from roughmap_schemas.layers import LAYERS
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.run.duplicates import Duplicates

S = 10**9
MIB = 1 << 20


def test_a_robot_that_floods_has_no_others_messages_forgotten() -> None:
    """What another robot handed in, and hands in again since it heard nothing, would enter the map twice."""
    known = Duplicates(10)
    known.add(("slow", "points", "a"), 1)
    for number in range(2, 100):
        known.add(("flood", "odometry", f"{number}"), number)
    assert known.find(("slow", "points", "a")) == 1
    assert [known.find(("flood", "odometry", f"{number}")) for number in (90, 91, 99)] == [None, 91, 99]
    assert [number for *_, number in known.to_state()] == [1, *range(91, 100)]
    again = Duplicates(10)
    again.load_state(known.to_state())
    assert again.to_state() == known.to_state()


def test_poses_that_wait_to_be_taken_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit they are busy; once those before them are taken, there is room again."""
    counters = Counters()
    monkeypatch.setattr("roughmap_service.inputs.queue.MAX_POSES", 3)
    queue = InputQueue(1000, counters)

    def put(number: int) -> None:
        queue.put(InputMessage(Kind.ODOMETRY, "rover", b"%d" % number, 0, 0.0))

    for number in range(5):
        put(number)
    assert counters.snapshot().refused == {"busy": 2}
    assert [message.payload for message in queue.take(0.0)[0]] == [b"0", b"1", b"2"]
    put(5)
    assert [message.payload for message in queue.take(0.0)[0]] == [b"5"]
    assert counters.snapshot().refused == {"busy": 2}


def test_a_message_too_large_to_be_put_together(tmp_path: Path) -> None:
    """What is too large is refused by name; what is far too large is never in memory, and the link goes on."""

    def peak(service: Service) -> int:
        status = Path(f"/proc/{service.process.pid}/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) << 10

    with Service(tmp_path, input={"max_message": MIB}) as service, connected(service) as feed:
        assert feed.refused("points", "rover", bytes(2 * MIB)) == "too_large"
        feed.settle()
        before = peak(service)
        for kind in ("points", "odometry"):
            feed.put(kind, "rover", bytes(128 * MIB))
        feed.session.get("maps/site/cells", payload=bytes(128 * MIB), timeout=0.1)
        assert feed.settle().refused == {"too_large": 1}
        assert peak(service) - before < 64 * MIB


def test_what_nobody_asked_for_is_not_kept_with_a_request(tmp_path: Path) -> None:
    """It would lie in memory until the answer, beside whatever else waits."""
    with Service(tmp_path) as service, connected(service) as feed:
        for key, sent in (
            ("maps/site/region?bbox=0,0,1,1", {"payload": bytes(2 * MIB)}),
            ("maps/site/tiles/0/*/*", {"attachment": bytes(2 * MIB)}),
            ("maps/site/cells?x=1;y=1", {"payload": bytes(2 * MIB)}),
            ("maps/site/status", {"attachment": bytes(2 * MIB)}),
            ("maps/site/control/reset", {"attachment": bytes(2 * MIB)}),
            ("maps/site/ingest/rover/odometry", {"payload": b"pose", "attachment": bytes(2 * MIB)}),
        ):
            (reply,) = feed.session.get(key, timeout=WAIT_S, **sent)
            assert reply.err is not None, key
            error = QueryError.model_validate_json(reply.err.payload.to_bytes())
            assert error.code == "too_large", key
            assert next(iter(sent.keys() & {"attachment"}), "payload") in error.message
        assert feed.settle().epoch == 1, "nothing was reset"
        assert service.stop() == 0


def test_layers_make_a_region_large(tmp_path: Path) -> None:
    """A few questions for all layers of a large region took gigabytes, though the map was empty."""
    with Service(tmp_path, query={"max_running_cells": 100_000}) as service, connected(service) as feed:
        for layers, found in ((LAYERS[:5], None), (LAYERS, "too_large")):
            region = f"maps/site/region?bbox=0,0,19,19;layers={','.join(layers)}"  # 36,100 cells or some more
            (reply,) = feed.session.get(region, timeout=WAIT_S)
            assert (reply.err is not None) == (found is not None)
            if reply.err is not None:
                error = QueryError.model_validate_json(reply.err.payload.to_bytes())
                assert (error.code, "query.max_running_cells" in error.message) == (found, True)
        assert service.stop() == 0


def test_a_selector_of_megabytes_does_not_fill_the_log(tmp_path: Path) -> None:
    with Service(tmp_path) as service, connected(service) as feed:
        (refusal,) = feed.session.get("maps/site/region?bbox=0,0,1,1;x=" + "y" * MIB, timeout=WAIT_S)
        assert refusal.err is not None
        assert QueryError.model_validate_json(refusal.err.payload.to_bytes()).code == "too_large"
        assert service.stop() == 0
    (record,) = [message.data for message in read_log(service.log) if message.topic == "maps/site/queries"]
    assert b"maps/site/region?bbox=0,0,1,1;x=yyy" in record
    assert len(record) < 4096


def test_robots(tmp_path: Path) -> None:
    """A robot beyond the limit is refused; the refusal names the setting."""
    with running(tmp_path, input={"max_robots": 2}) as (_, feed):
        for number, robot in enumerate(("rover", "other")):
            feed.pose(robot, T0 + number * S // 10)
        key, payload = "maps/site/ingest/third/odometry", encode_odometry(T0, "map", (0, 0, 0), LEVEL)
        (error,) = ask(feed.session, key, timeout=30.0, payload=payload).errors
        refusal = QueryError.model_validate_json(error[0])
        assert refusal.code == "unknown_robot"
        assert "2 robots" in refusal.message
        assert "input.max_robots" in refusal.message
