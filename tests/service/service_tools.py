"""A run without a network: messages made, logged, decided and applied as the sequencer does it, and read back."""

import shutil
import uuid
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from roughmap_schemas import (
    CheckpointEvent,
    Config,
    Event,
    IntegrationEvent,
    Keys,
    ResetEvent,
    RunMetadata,
    encode_cloud,
    encode_event,
    encode_odometry,
    encode_transform,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.engine.recovery import Recovered, blank
from roughmap_service.journal.file import open_new
from roughmap_service.journal.items import Rotate
from roughmap_service.journal.records import EventRecord, FileStart, InputRecord, LogItem, LogRecord
from roughmap_service.journal.run_files import find_files, one_run, read_run
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.apply import span
from roughmap_service.run.duplicates import Duplicates
from roughmap_service.run.fold import decode
from roughmap_service.run.inbox import Inbox, WaitingCloud
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Store
from roughmap_service.store.snapshots import Snapshots, cut_of
from roughmap_service.store.spill import Spill

T0 = 1_700_000_000 * 10**9
"""Where the stamps of tests begin, in ns."""

SECOND = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)
PRECISE = np.eye(6) * 1e-6
WAIT_S = 30.0
"""How long a test waits for something that ought to happen at once."""

GROUND = np.array([[1.0, 0.0, -0.5], [1.5, 0.5, -0.4], [2.0, -0.5, -0.6], [1.2, 0.3, -0.5]])
"""A small cloud in front of a sensor."""


def config(**sections: Any) -> Config:
    """The tests' configuration with ``sections`` over it."""
    values: dict[str, Any] = {"sensors": {"lidar": {"range_sigma": 0.01}}}
    for name, given in sections.items():
        values[name] = {**values.get(name, {}), **given}
    return Config.model_validate(values)


def metadata(**values: Any) -> RunMetadata:
    """The beginning of a run's first file."""
    given: dict[str, Any] = {
        "run": "0123456789abcdef" * 2,
        "created_ns": T0,
        "epoch": 1,
        "index": 0,
        "first_input": 1,
        "first_record": 1,
        "base_sequence": 0,
        "base_digest": "",
        "version": version("roughmap"),
        "configuration": config().public_dict(),
        **values,
    }
    return RunMetadata(**given)


def odometry(t: float, x: float = 0.0, frame: str = "map", y: float = 0.0) -> bytes:
    """A level pose ``t`` seconds after T0."""
    return encode_odometry(T0 + round(t * SECOND), frame, (x, y, 1.0), LEVEL, PRECISE)


def cloud(t: float, shift: float = 0.0, frame: str = "lidar", points: np.ndarray = GROUND) -> bytes:
    """A cloud ``t`` seconds after T0, its points moved by ``shift`` along x."""
    return encode_cloud(points + np.array([shift, 0.0, 0.0]), T0 + round(t * SECOND), frame)


def transform(t: float, x: float = 0.0, child: str = "odom") -> bytes:
    """Where the frame ``child`` lies in the map from ``t`` seconds after T0 on."""
    return encode_transform(T0 + round(t * SECOND), "map", child, (x, 0.0, 0.0), LEVEL)


class Run:
    """A run that goes on from ``recovered`` (None: a new one); a context manager that closes its log.

    Time is what the test says: a cloud arrives at 0.0, and `decide` tells which moment it is.
    """

    def __init__(
        self,
        directory: Path,
        settings: Config | None = None,
        *,
        recovered: Recovered | None = None,
        store: Store | None = None,
        open_file: Callable[[Path], IO[bytes]] = open_new,
        created_ns: int = T0,
        spill: Spill | None = None,
    ) -> None:
        self.config = settings or config()
        self.directory = directory
        directory.mkdir(parents=True, exist_ok=True)
        self.recovered = recovered or blank(self.config)
        self.state = self.recovered.state
        self.state.epoch = self.recovered.epoch
        self.run = self.recovered.run or uuid.uuid4().hex
        self.keys = Keys("site", self.config.keys)
        self.inbox = Inbox(self.state.settings, self.state.poses)
        self.duplicates = self.recovered.duplicates
        self.view = View(self.state.map, self.state.epoch)
        first = metadata(
            run=self.run,
            created_ns=created_ns,
            epoch=self.state.epoch,
            index=self.recovered.index,
            first_input=self.state.input + 1,
            first_record=self.state.record + 1,
            base_sequence=self.state.map.sequence,
            base_digest=self.state.map.digest(),
            configuration=self.config.public_dict(),
        )
        self.writer = LogWriter(directory, first, open_file=open_file)
        stored = None if self.recovered.was_reset else self.recovered.cut
        self.snapshots = Snapshots(store, self.view, self.writer, stored, keep=self.config.log.keep, spill=spill)
        for number, robot, size in self.recovered.undecided:
            self._feed(number, robot, size)

    def put(self, kind: Kind, payload: bytes, robot: str = "rover") -> int:
        """Log an input and take it up; its number."""
        number = self.state.input = self.state.input + 1
        self.state.record += 1
        content = decode(kind, payload, self.state.settings)
        topic = self.keys.form(kind).make(robot=robot)
        self.writer.put(LogRecord(kind, topic, payload, T0, content.stamp_ns, number))
        self.duplicates.add(Duplicates.identity(robot, kind, payload), number)
        if kind is Kind.POINTS:
            self.state.take_cloud(number, content)
            self._feed(number, robot, len(payload))
        elif kind is Kind.ODOMETRY:
            if self.state.take_odometry(number, robot, content)[1]:
                self.inbox.clock_reset(robot)
        else:
            self.state.take_transform(number, robot, content)
        return number

    def _feed(self, number: int, robot: str, size: int) -> None:
        held = self.state.clouds[number]
        self.inbox.feed(WaitingCloud(number, robot, held, *span(held), 0.0, size, promised=False))

    def decide(self, now: float = 0.0) -> list[IntegrationEvent]:
        """Apply every decision that is due at monotonic time ``now``."""
        done = []
        while (decision := self.inbox.tick(now)) is not None:
            proposal = IntegrationEvent(
                epoch=0,
                input=decision.cloud.input,
                robot=decision.cloud.robot,
                poses=[(pose.input, pose.transform) for pose in decision.poses],
                outcome=decision.outcome,
                accepted=0,
                rejected={},
                sequence=0,
            )
            event = self.event(proposal)
            assert isinstance(event, IntegrationEvent)
            done.append(event)
        return done

    def event(self, proposal: Event) -> Event:
        """Apply an event and log how it came out."""
        integration = isinstance(proposal, IntegrationEvent)
        change = self.state.prepare(proposal, self.view.reading) if integration else lambda: self.state.apply(proposal)
        with self.view.change():
            event = change()
            self.view.epoch = self.state.epoch
        self.log_event(event)
        return event

    def log_event(self, event: Event) -> None:
        """Log an event, whether it is true or not."""
        self.state.record += 1
        topic, payload = self.keys.events, encode_event(event)
        self.writer.put(LogRecord(Kind.EVENTS, topic, payload, T0, T0, 0, event.epoch, event.sequence))

    def checkpoint(self) -> Event:
        """Log the map's digest."""
        return self.event(CheckpointEvent(epoch=0, sequence=0, digest="0" * 32))

    def reset(self) -> Event:
        """Empty the map."""
        return self.event(ResetEvent(epoch=0, sequence=0))

    def rotate(self) -> None:
        """Checkpoint, and go on in a new file."""
        self.checkpoint()
        self.writer.put(Rotate(self.state.map.digest()))

    def scan(self, t: float, x: float = 0.0, robot: str = "rover") -> IntegrationEvent:
        """A pose before and one after a cloud, and the cloud decided."""
        self.put(Kind.ODOMETRY, odometry(t, x), robot)
        self.put(Kind.POINTS, cloud(t + 0.05), robot)
        self.put(Kind.ODOMETRY, odometry(t + 0.1, x + 0.1), robot)
        return self.decide()[-1]

    def snapshot(self) -> None:
        """Store the run's cut, and wait until it is there."""
        thread = self.snapshots.offer(lambda: cut_of(self.run, self.config, self.state, self.inbox, self.duplicates))
        assert thread is not None
        thread.join(WAIT_S)
        assert not thread.is_alive()
        assert not self.snapshots.error

    def killed(self, where: Path) -> Path:
        """What a kill at this moment would leave, with all that was logged on the disk: a copy of the log folder."""
        assert self.writer.wait_synced(WAIT_S)
        return Path(shutil.copytree(self.directory, where))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.snapshots.wait(WAIT_S)
        assert self.writer.close(WAIT_S) or error is not None


def read_back(*paths: Path) -> list[LogItem]:
    """All items of the run in these folders."""
    return list(read_run(one_run(find_files(paths))))


def inputs_of(items: Iterable[LogItem]) -> list[InputRecord]:
    """The inputs among them."""
    return [item for item in items if isinstance(item, InputRecord)]


def events_of(items: Iterable[LogItem]) -> list[Event]:
    """The events among them."""
    return [item.event for item in items if isinstance(item, EventRecord)]


def starts_of(items: Iterable[LogItem]) -> list[FileStart]:
    """The file beginnings among them."""
    return [item for item in items if isinstance(item, FileStart)]
