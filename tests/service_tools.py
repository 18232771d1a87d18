"""A run without a network: messages are logged, decided and applied as the sequencer does it, and read back."""

import shutil
import uuid
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from roughmap.arrays import I4
from roughmap_schemas import (
    CheckpointEvent,
    Config,
    Event,
    IntegrationEvent,
    Keys,
    ResetEvent,
    RunMetadata,
    encode_cloud,
    encode_odometry,
    encode_transform,
)
from roughmap_schemas.kinds import Kind
from roughmap_service.answers.emptied_tiles import EmptiedHistory
from roughmap_service.engine.live_run import LiveRun
from roughmap_service.engine.recovery import Recovered, blank
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.inputs.streams import Streams
from roughmap_service.journal.file import open_new
from roughmap_service.journal.items import Rotate
from roughmap_service.journal.recorder import Recorder
from roughmap_service.journal.records import EventRecord, FileStart, InputRecord, LogItem
from roughmap_service.journal.run_files import find_files, one_run, read_run
from roughmap_service.journal.writer import LogWriter
from roughmap_service.run.metadata import file_metadata
from roughmap_service.run.view import View
from roughmap_service.store.map_db import Cut, Store
from roughmap_service.store.memory_limit import MemoryLimit
from roughmap_service.store.snapshots import Snapshots, cut_of
from roughmap_service.store.spill import Spill

T0 = 1_700_000_000 * 10**9
"""First stamp of the tests, in ns."""

SECOND = 10**9
LEVEL = (0.0, 0.0, 0.0, 1.0)
PRECISE = np.eye(6) * 1e-6
WAIT_S = 60.0
"""How long a test waits for something that normally happens at once."""

GROUND = np.array([[1.0, 0.0, -0.5], [1.5, 0.5, -0.4], [2.0, -0.5, -0.6], [1.2, 0.3, -0.5]])
"""A small cloud in front of a sensor."""


def config(**sections: Any) -> Config:
    """Return the tests' configuration, overridden by ``sections``."""
    values: dict[str, Any] = {"sensors": {"lidar": {"range_sigma": 0.01}}}
    for name, given in sections.items():
        values[name] = {**values.get(name, {}), **given}
    return Config.model_validate(values)


def metadata(**values: Any) -> RunMetadata:
    """Return the metadata of a run's first file."""
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
    """Return a level pose ``t`` seconds after T0."""
    return encode_odometry(T0 + round(t * SECOND), frame, (x, y, 1.0), LEVEL, PRECISE)


def cloud(t: float, shift: float = 0.0, frame: str = "lidar", points: np.ndarray = GROUND) -> bytes:
    """Return a cloud ``t`` seconds after T0, its points moved by ``shift`` along x."""
    return encode_cloud(points + np.array([shift, 0.0, 0.0]), T0 + round(t * SECOND), frame)


def transform(t: float, x: float = 0.0, child: str = "odom") -> bytes:
    """Return the transform of the frame ``child`` in the map from ``t`` seconds after T0 on."""
    return encode_transform(T0 + round(t * SECOND), "map", child, (x, 0.0, 0.0), LEVEL)


class LoggedRun:
    """A live run without a sequencer's thread: `put` accepts a message at once, `decide` decides what is due.

    It continues from ``recovered`` (None: a new run). A context manager that closes its log. Messages arrive at
    monotonic time 0.0; `decide` takes the current time.
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
        emptied: Callable[[I4, int], None] | None = None,
    ) -> None:
        self.config = settings or config()
        self.directory = directory
        directory.mkdir(parents=True, exist_ok=True)
        self._open = ExitStack()
        self.recovered = recovered or blank(self.config)
        self.run = self.recovered.run
        self.run.epoch = self.recovered.epoch
        self.run_id = self.recovered.run_id or uuid.uuid4().hex
        self.view = View(self.run.map, self.run.epoch)
        first = file_metadata(
            self.run_id, self.run, self.config, epoch=self.run.epoch, index=self.recovered.index, created_ns=created_ns
        )
        self.keys = Keys("site", self.config.keys)
        self.writer = LogWriter(directory, first, open_file=open_file)
        self.recorder = Recorder(self.writer, self.keys)
        stored = None if self.recovered.was_reset else self.recovered.cut
        self.snapshots = Snapshots(store, self.view, self.writer, stored, keep=self.config.log.keep, spill=spill)
        apart = self._open.enter_context(TemporaryDirectory())  # not among the files that a test looks at
        shelf = spill or self._open.enter_context(Spill(Path(apart, "tiles.spill"), 0))
        memory = MemoryLimit(1 << 50, shelf)
        self.published: list[bytes] = []
        self.emptied = EmptiedHistory(1 << 20)
        self.counters = Counters()
        self.streams = Streams(self.config)
        self.live = LiveRun(
            self.run, self.view, self.writer, self.recorder, self.counters, memory, self.streams, self.published.append,
            emptied or self.emptied.note,
        )  # fmt: skip
        self.run.resume(0.0)

    def put(self, kind: Kind, payload: bytes, robot: str = "rover") -> int:
        """Log an input and apply it; return its number."""
        number = self.live.accept(InputMessage(kind, robot, payload, T0, 0.0), 0.0)
        assert number is not None, "refused"
        return number

    def decide(self, now: float = 0.0) -> list[IntegrationEvent]:
        """Decide and apply all that is due at monotonic time ``now``."""
        done = []
        while (event := self.live.decide(now)) is not None:
            done.append(event)
        return done

    def log_event(self, event: Event) -> None:
        """Log an event, true or not."""
        self.run.record += 1
        self.recorder.event(event, T0)

    def checkpoint(self) -> CheckpointEvent:
        """Log the map's digest."""
        event = self.run.checkpoint()
        self.log_event(event)
        return event

    def reset(self) -> ResetEvent:
        """Empty the map."""
        event = self.live.log_reset()
        self.live.empty(event, publish=True)
        return event

    def rotate(self) -> None:
        """Checkpoint, and continue in a new file."""
        self.checkpoint()
        self.writer.put(Rotate(self.run.map.digest()))

    def scan(self, t: float, x: float = 0.0, robot: str = "rover") -> IntegrationEvent:
        """Put a pose, a cloud and a later pose, ``t`` tenths of a second after T0; decide the cloud."""
        self.put(Kind.ODOMETRY, odometry(t * 0.1, x), robot)
        self.put(Kind.POINTS, cloud(t * 0.1 + 0.03), robot)
        self.put(Kind.ODOMETRY, odometry(t * 0.1 + 0.06, x + 0.1), robot)
        return self.decide()[-1]

    def skip_to(self, t: float, x: float = 0.0, robot: str = "rover") -> None:
        """Put three poses before ``t`` tenths of a second after T0, so that a scan there is believed after a gap."""
        for before in (3, 2, 1):
            self.put(Kind.ODOMETRY, odometry((t - before) * 0.1, x), robot)

    def cut(self) -> Cut:
        """Return the run's current cut."""
        return cut_of(self.run_id, self.config, self.run)

    def snapshot(self) -> None:
        """Store the run's cut, and wait for it."""
        thread = self.snapshots.offer(self.cut)
        assert thread is not None
        thread.join(WAIT_S)
        assert not thread.is_alive()
        assert not self.snapshots.error

    def killed(self, where: Path) -> Path:
        """Copy the log folder as a kill at this moment would leave it, with everything logged so far on disk."""
        assert self.writer.wait_synced(WAIT_S)
        return Path(shutil.copytree(self.directory, where))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._open:
            self.snapshots.wait(WAIT_S)
            assert self.writer.close(WAIT_S) or error is not None


def read_back(*paths: Path) -> list[LogItem]:
    """Return all items of the run in these folders."""
    return list(read_run(one_run(find_files(paths))))


def inputs_of(items: Iterable[LogItem]) -> list[InputRecord]:
    """Return the inputs among them."""
    return [item for item in items if isinstance(item, InputRecord)]


def events_of(items: Iterable[LogItem]) -> list[Event]:
    """Return the events among them."""
    return [item.event for item in items if isinstance(item, EventRecord)]


def starts_of(items: Iterable[LogItem]) -> list[FileStart]:
    """Return the file starts among them."""
    return [item for item in items if isinstance(item, FileStart)]
