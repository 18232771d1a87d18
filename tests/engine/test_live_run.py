"""When a cloud is decided, and what must come before what: the log before the eyes, poses before the end of a wait."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from disks import FailingDisk
from net import Gathered, wait_for
from sequencers import ample_memory, sequencer_of
from service_tools import T0, WAIT_S, LoggedRun, cloud, config, odometry

from roughmap_schemas import Event, IntegrationEvent, decode_event
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.live_run import LiveRun
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import TURN_MESSAGES, InputMessage, InputQueue
from roughmap_service.journal import writer as log_writer
from roughmap_service.journal.items import Sync
from roughmap_service.journal.recorder import Recorder


class Spied(Recorder):
    """Tells when an event is queued to the log, and queues nothing."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell = tell

    def event(self, event: Event, now_ns: int) -> None:
        self._tell()


def test_an_event_is_on_its_way_to_the_log_before_anyone_can_see_what_it_did(tmp_path: Path) -> None:
    """It is queued while the map is still held, and published when it no longer is."""
    told: list[tuple[str, bool]] = []
    with LoggedRun(tmp_path / "log") as run, ample_memory(tmp_path) as enough:
        run.put(Kind.POINTS, cloud(1.0, frame="map"))
        held = Spied(lambda: told.append(("log", run.view._lock.locked())))
        live = LiveRun(
            run.run, run.view, run.writer, held, Counters(), enough, run.streams,
            lambda _: told.append(("publish", run.view._lock.locked())), run.emptied.note,
        )  # fmt: skip
        assert live.decide(0.0)
    assert told == [("log", True), ("publish", False)]


def test_nothing_is_decided_while_the_log_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What could be placed and what only has to end wait for the log, and come out as they would have."""
    monkeypatch.setattr(log_writer, "RETRY_SECONDS", 0.001)
    disk = FailingDisk()
    with LoggedRun(tmp_path / "log", open_file=disk.open) as run:
        run.put(Kind.POINTS, cloud(1.0, frame="map"))
        run.put(Kind.POINTS, cloud(2.0), "blind")
        assert run.writer.wait_synced(WAIT_S)
        live, late = run.live, 1e9  # long past every wait
        disk.broken = True
        failed = threading.Event()
        run.writer.put(Sync(lambda: None, lambda _: failed.set()))
        wait_for(failed, "the writer to notice")
        assert not live.advance(late)
        assert (run.published, run.run.map.sequence, len(run.run.clouds)) == ([], 0, 2)
        disk.broken = False
        assert run.writer.wait_room(WAIT_S)
        while live.advance(late):
            pass
    events = [decode_event(event) for event in run.published]
    assert [(event.outcome, event.sequence) for event in events] == [("integrated", 1), ("no_pose", 1)]


def test_no_wait_ends_before_all_that_came_in_it_is_taken_up(tmp_path: Path) -> None:
    """The pose that a cloud needs came with it, behind more poses than are taken at a time."""
    decided: Gathered[IntegrationEvent] = Gathered()
    intake, counters = InputQueue(1 << 20, Counters()), Counters()
    patience = 1e-4  # which is over before the first turn is
    with LoggedRun(tmp_path / "log", config(input={"max_wait": patience})) as run, ample_memory(tmp_path) as enough:

        def hear(payload: bytes) -> None:
            event = decode_event(payload)
            if isinstance(event, IntegrationEvent):
                decided(event)

        live = LiveRun(
            run.run, run.view, run.writer, run.recorder, counters, enough, run.streams, hear, run.emptied.note
        )
        sequencer = sequencer_of(live, intake, run.writer, enough)
        arrival = time.monotonic()
        messages = [(Kind.POINTS, cloud(1.0005 + TURN_MESSAGES * 1e-3))]
        messages += [(Kind.ODOMETRY, odometry(1.0 + k * 1e-3)) for k in range(TURN_MESSAGES + 2)]
        for kind, payload in messages:
            intake.put(InputMessage(kind, "rover", payload, T0, arrival))
        sequencer.start()
        (event,) = decided.wait(bool, "the decision")
        assert event.outcome == "integrated"
        assert sequencer.stop(WAIT_S)
