"""`roughmap replay`: a log that is whole replays as equal; one that was touched doesn't, or is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from log_edits import nth, rewrite
from replay_tools import drive, refused, replay, stored, three_files
from service_tools import (
    GROUND,
    LEVEL,
    PRECISE,
    SECOND,
    T0,
    WAIT_S,
    LoggedRun,
    cloud,
    config,
)

from roughmap_schemas import IntegrationEvent, PointReason, decode_event, encode_event, encode_odometry
from roughmap_service.engine.recovery import recover
from roughmap_service.store.map_db import Store, StoreError


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return tmp_path / "log"


def test_a_whole_log_is_equal(logs: Path, tmp_path: Path) -> None:
    run = three_files(logs)
    digest = run.run.map.digest()
    equal = f"equal: 8 checkpoints, sequence 6, digest {digest}"
    assert replay(logs)[:2] == (0, equal)
    files = sorted(logs.glob("*.mcap"))
    assert replay(*reversed(files))[:2] == (0, equal), "their order is theirs, not the command line's"
    assert replay(logs, files[1])[:2] == (0, equal), "a file that is named twice is one file"
    code, told, _ = replay(logs, "--json", "-o", tmp_path / "map.db")
    assert (code, json.loads(told)) == (0, {"verdict": equal, "equal": True, "events": 14})
    assert stored(tmp_path / "map.db").digest() == digest
    with pytest.raises(StoreError, match="the newest log of run"):
        recover(config(), logs, Store(tmp_path / "map.db"))


def test_resets_and_restarts_with_other_settings_are_equal(logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
        run.reset()
        drive(run, 4)
    for sigma, first in ((0.02, 7), (0.03, 10)):
        other = config(sensors={"lidar": {"range_sigma": sigma}})
        with LoggedRun(logs, other, recovered=recover(other, logs, None)) as run:
            drive(run, first)
    assert replay(logs)[:2] == (0, f"equal: 12 checkpoints, sequence 13, digest {run.run.map.digest()}")


def fewer(data: bytes) -> bytes:
    event = decode_event(data)
    assert isinstance(event, IntegrationEvent)
    return encode_event(event.model_copy(update={"accepted": event.accepted - 1}))


def far(data: bytes) -> bytes:
    event = decode_event(data)
    assert isinstance(event, IntegrationEvent)
    return encode_event(event.model_copy(update={"rejected": {PointReason.RANGE: 1}}))


AGAIN = encode_event(
    IntegrationEvent(
        epoch=1,
        input=2,
        robot="rover",
        poses=[(1, 0), (3, 0)],
        outcome="integrated",
        accepted=4,
        rejected={},
        sequence=2,
    )
)
MOVED = GROUND.copy()
MOVED[1, 2] += 1e-3
HIGHER = encode_odometry(T0 + SECOND // 10, "map", (0.3, 0.0, 1.001), LEVEL, PRECISE)
CHANGES: dict[str, tuple[str, int, Callable[[bytes], bytes | None], str]] = {
    "a point moved by 1 mm": ("/points", 1, lambda _: cloud(0.13, points=MOVED), "sequence 2 (checkpoint): digest"),
    "a pose moved by 1 mm": ("/odometry", 2, lambda _: HIGHER, "sequence 2 (checkpoint): digest"),
    "a pose left out": ("/odometry", 2, lambda _: None, "sequence 2: an event names input 5"),
    "a cloud left out": ("/points", 1, lambda _: None, "sequence 2: an event names input 5"),
    "a scan's event left out": ("/events", 2, lambda _: None, "sequence 2 (checkpoint): sequence 2 in the log, 1 now"),
    "a scan's event twice": ("/events", 1, lambda _: AGAIN, "sequence 2: an event names input 2"),
    "another outcome": ("/events", 2, fewer, "sequence 2 (integration): accepted 3 in the log, 4 now"),
    "other reasons": ("/events", 2, far, "sequence 2 (integration): rejected {'range': 1} in the log, {} now"),
    "bytes that are no cloud": ("/points", 1, lambda data: data[:-9], "sequence 1: input 5 can't be read"),
}
"""Which message, what becomes of it, and what the last line says then behind `differs at`."""


@pytest.mark.parametrize("name", CHANGES)
def test_a_log_that_was_touched_differs(name: str, logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    (file,) = logs.glob("*.mcap")
    rewrite(file)
    assert replay(logs)[0] == 0, "only what the edit changes may make a difference"
    topic, n, change, told = CHANGES[name]
    rewrite(file, nth(topic, n, change))
    code, last, _ = replay(logs)
    assert (code, last.startswith(f"differs at {told}")) == (1, True), last


def test_a_file_that_begins_with_another_map_differs(logs: Path) -> None:
    three_files(logs)
    file = sorted(logs.glob("*.mcap"))[1]
    rewrite(file, base_digest="f" * 32)
    code, last, _ = replay(logs)
    assert (code, last.split(":")[0]) == (1, "differs at sequence 2")
    assert file.name in last


def test_nothing_is_written_after_a_difference(logs: Path, tmp_path: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    (file,) = logs.glob("*.mcap")
    rewrite(file, nth("/points", 1, lambda _: cloud(0.13, points=MOVED)))
    code, last, told = replay(logs, "-o", tmp_path / "map.db", "--log-out", tmp_path / "new")
    assert (code, last.split(":")[0]) == (1, "differs at sequence 2 (checkpoint)")
    assert "the other options were not carried out" in told
    assert not (tmp_path / "map.db").exists()
    assert not (tmp_path / "new").exists()


def test_what_is_no_whole_run_is_refused(logs: Path, tmp_path: Path) -> None:
    three_files(logs)
    files = sorted(logs.glob("*.mcap"))
    refused(replay(files[0], files[2]), "gap: file 1 of run")
    refused(replay(files[1], files[2]), "(sequence 2), not at the beginning of the run")
    shutil.copy(files[1], tmp_path / "copy.mcap")
    refused(replay(logs, tmp_path / "copy.mcap"), "are both file 1 of run")
    with LoggedRun(tmp_path / "other") as other:
        drive(other, 0, 1)
    refused(replay(logs, tmp_path / "other"), "logs of 2 runs")
    (tmp_path / "empty").mkdir()
    refused(replay(tmp_path / "empty"), f"no log files (*.mcap) in {tmp_path / 'empty'}")
    refused(replay(tmp_path / "nowhere"), "nowhere")


def test_a_file_that_lost_its_end_in_the_middle_is_a_gap(logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run, 0, 1)
        assert run.writer.wait_synced(WAIT_S)
        whole = run.writer.size
        drive(run, 1, 1)
        run.rotate()
        drive(run, 2, 1)
    file = sorted(logs.glob("*.mcap"))[0]
    file.write_bytes(file.read_bytes()[:whole])
    refused(replay(logs), "gap: ")
    (sorted(logs.glob("*.mcap"))[1]).unlink()
    assert replay(logs)[:2] == (0, replay(file)[1]), "as the last file it is what a kill left"


def test_a_store_that_holds_the_whole_log_leaves_nothing_to_compare(logs: Path, tmp_path: Path) -> None:
    with LoggedRun(logs, store=Store(tmp_path / "map.db")) as run:
        drive(run)
        run.snapshot()
    told = f"{tmp_path / 'map.db'} already contains all of this log (sequence 3), so there is nothing to compare"
    refused(replay("--from", tmp_path / "map.db", logs), told)


def test_a_log_without_a_checkpoint_proves_nothing(logs: Path) -> None:
    with LoggedRun(logs) as run:
        run.scan(0.0)
    refused(replay(logs), "no checkpoint")


def test_an_event_of_an_unknown_kind_stops_the_reader(logs: Path) -> None:
    with LoggedRun(logs) as run:
        drive(run)
    (file,) = logs.glob("*.mcap")
    rewrite(file, nth("/events", 2, lambda _: b'{"kind": "forget", "epoch": 1, "sequence": 2}'))
    refused(replay(logs), "event at record 9")
