"""`roughmap serve` as a process: start, feed, query and stop it, and read its log.

Every wait is bounded and on an event; the service listens on a port that the system chooses, on loopback.
"""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pytest
import zenoh
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from net import WAIT_S, Gathered, peer_config, wait_for

from roughmap_client import QueryRefused, RoughMapClient
from roughmap_client.session import ask
from roughmap_schemas import (
    Event,
    IntegrationEvent,
    MapStatus,
    QueryError,
    Receipt,
    decode_event,
    encode_cloud,
    encode_odometry,
)
from roughmap_service.cli.main import run

READY_S = 200.0
"""A first start compiles every kernel, on what may be a slow and busy machine."""

END_S = 60.0
"""The tests' shutdown_timeout: beside busy neighbours, what is queued takes longer than the default."""

STOP_S = 90.0
"""Past it the service hangs."""

T0 = 1_700_000_000 * 10**9
"""First stamp of the tests, in ns. It is far from the wall clock, which must not matter."""

LEVEL = (0.0, 0.0, 0.0, 1.0)
"""The quaternion of no rotation."""

PRECISE = np.eye(6) * 1e-6
"""A pose covariance of a millimetre and a milliradian, so that points hit the intended cells."""

GROUND = np.array([[1.0, 0.0, -0.5], [1.5, 0.5, -0.4], [2.0, -0.5, -0.6], [1.2, 0.3, -0.5]])
"""A small cloud in front of a sensor."""

COMMAND = (sys.executable, "-m", "roughmap_service.cli.main")


def toml(sections: Mapping[str, Any], prefix: str = "") -> str:
    """Return nested tables of strings, numbers, booleans and lists as TOML; JSON writes these values alike."""
    plain = "".join(f"{k} = {json.dumps(v)}\n" for k, v in sections.items() if not isinstance(v, Mapping))
    tables = "".join(toml(v, f"{prefix}{k}.") for k, v in sections.items() if isinstance(v, Mapping))
    return (f"[{prefix[:-1]}]\n" if prefix and (plain or not sections) else "") + plain + tables


def environment() -> dict[str, str]:
    """Return this environment without settings that would change the service."""
    return {name: value for name, value in os.environ.items() if not name.startswith("ROUGHMAP_")}


def configuration(directory: Path, settings: Mapping[str, Any]) -> Path:
    """Write a configuration file in ``directory``: the tests' defaults, overridden by ``settings``."""
    sections: dict[str, Any] = {
        "zenoh": {"listen": ["tcp/127.0.0.1:0"]},
        "log": {"directory": str(directory / "log")},
        "service": {"alive_wait": 0.2, "shutdown_timeout": END_S},
        "http": {"listen": ""},
        "sensors": {"lidar": {"range_sigma": 0.01}},
    }
    for name, values in settings.items():
        sections[name] = {**sections.get(name, {}), **values}
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "roughmap.toml"
    path.write_text(toml(sections))
    return path


class Service:
    """One `roughmap serve`; a context manager that kills it if it still runs at the end.

    ``settings`` are sections over the tests' defaults: ``Service(tmp, map={"cell_size": 0.2})``; ``environ`` is added
    to the environment.
    """

    def __init__(
        self, directory: Path, *arguments: str, environ: Mapping[str, str] | None = None, **settings: Mapping[str, Any]
    ) -> None:
        self.directory = directory
        self.log = directory / "log"
        config = configuration(directory, settings)
        self.process = subprocess.Popen(
            [*COMMAND, "serve", "-c", str(config), *arguments],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**environment(), **(environ or {})},
        )  # fmt: skip
        self.out: list[str] = []
        self.err: list[str] = []
        self._ready = threading.Event()
        self._said = threading.Condition()
        self._readers = [
            threading.Thread(target=self._read, args=(self.process.stdout, self.out), daemon=True),
            threading.Thread(target=self._read, args=(self.process.stderr, self.err), daemon=True),
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: Any, lines: list[str]) -> None:
        for line in stream:
            with self._said:
                lines.append(line.rstrip("\n"))
                self._said.notify_all()
            if lines is self.out:
                self._ready.set()
        if lines is self.out:
            self._ready.set()

    def ready(self) -> dict[str, Any]:
        """Wait for the ready line and return it."""
        wait_for(self._ready, "the ready line", READY_S)
        if not self.out:
            self.finished()
            raise AssertionError("the service ended before it was ready: " + "\n".join(self.err))
        line: dict[str, Any] = json.loads(self.out[0])
        return line

    def line(self, text: str, seconds: float = WAIT_S) -> str:
        """Wait for a line on stderr that holds ``text``; return the first one."""
        with self._said:
            found = self._said.wait_for(lambda: [line for line in self.err if text in line], seconds)
            assert found, f"waited {seconds:g} s in vain for a line with {text!r}"
            return found[0]

    def finished(self, seconds: float = STOP_S) -> int:
        """Wait for the end and read all output; return the exit code."""
        code = self.process.wait(seconds)
        for reader in self._readers:
            reader.join(WAIT_S)
        return code

    def stop(self, number: signal.Signals = signal.SIGTERM, seconds: float = STOP_S) -> int:
        """Send a signal and wait for the end; return the exit code."""
        self.process.send_signal(number)
        return self.finished(seconds)

    def kill(self) -> None:
        """Kill it with SIGKILL."""
        self.process.kill()
        self.finished()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.process.poll() is None:
            self.kill()
        assert self.process.stdout is not None
        assert self.process.stderr is not None
        self.process.stdout.close()
        self.process.stderr.close()


class Feed:
    """One session with a service: publishes, ingests, queries, and gathers the events that the service publishes."""

    def __init__(self, session: zenoh.Session, map_name: str = "site") -> None:
        self.session = session
        self.map = map_name
        self.client = RoughMapClient(map_name, session=session, timeout=WAIT_S)
        self.events: Gathered[Event] = Gathered()
        self._subscriber = session.declare_subscriber(
            f"maps/{map_name}/events", lambda sample: self.events(decode_event(sample.payload.to_bytes()))
        )
        self._settle = encode_odometry(T0, "map", (0, 0, 0), LEVEL)
        self.settles = 1
        # The first answer shows that the service's declarations are here, so that nothing published now goes nowhere.
        self.ingest("odometry", "settle", self._settle)

    def put(self, kind: str, robot: str, payload: bytes, **options: Any) -> None:
        """Publish a message; nothing is dropped on this side."""
        options.setdefault("congestion_control", zenoh.CongestionControl.BLOCK)
        self.session.put(f"robots/{robot}/{kind}", payload, **options)

    def ingest(self, kind: str, robot: str, payload: bytes) -> Receipt:
        """Ingest a message and wait for its receipt."""
        return self.client.ingest(payload, robot, kind=kind)  # type: ignore[arg-type]

    def refused(self, kind: str, robot: str, payload: bytes | None, encoding: str | None = None) -> str:
        """Ingest a message that must be refused; return the code of the one error reply."""
        key = f"maps/{self.map}/ingest/{robot}/{kind}"
        with pytest.raises(QueryRefused) as refusal:
            ask(self.session, key, timeout=WAIT_S, payload=payload, encoding=encoding).single()
        return refusal.value.code

    def send(self, kind: str, robot: str, payload: bytes, answered: Callable[[Receipt | str], None]) -> None:
        """Ingest a message without waiting: ``answered`` gets the receipt or the code of a refusal, if any."""

        def reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                answered(Receipt.model_validate_json(reply.ok.payload.to_bytes()))
            elif reply.err is not None and reply.err.payload.to_bytes() != b"Timeout":  # Zenoh's own
                answered(QueryError.model_validate_json(reply.err.payload.to_bytes()).code)

        self.session.get(
            f"maps/{self.map}/ingest/{robot}/{kind}", reply, payload=payload, timeout=WAIT_S,
            consolidation=zenoh.ConsolidationMode.NONE,
        )  # fmt: skip

    def cloud(self, robot: str, stamp_ns: int, points: Any = GROUND, frame: str = "lidar", **more: Any) -> int:
        """Ingest a cloud; return its input number."""
        return self.ingest("points", robot, encode_cloud(points, stamp_ns, frame, **more)).input

    def pose(self, robot: str, stamp_ns: int, position: Any = (0.0, 0.0, 0.0), rotation: Any = LEVEL) -> None:
        """Publish a precise pose of the robot in the map's frame."""
        self.put("odometry", robot, encode_odometry(stamp_ns, "map", position, rotation, PRECISE))

    def settle(self) -> MapStatus:
        """Return the status once everything sent before is applied, and every decision so far is on disk.

        A link and the sequencer keep the order. So the receipt of a message that is sent after the rest (a duplicate,
        which is neither logged nor counted) comes after them. Only the first one after a reset of the map is logged;
        ``settles`` counts these, and the one at the beginning.
        """
        if not self.ingest("odometry", "settle", self._settle).duplicate:
            self.settles += 1
            assert self.ingest("odometry", "settle", self._settle).duplicate
        return self.client.status()

    def decided(self, number: int) -> IntegrationEvent:
        """Wait for the event of the cloud with that input number; return it."""

        def found(events: list[Event]) -> list[IntegrationEvent]:
            return [e for e in events if isinstance(e, IntegrationEvent) and e.input == number]

        return found(self.events.wait(lambda events: bool(found(events)), f"the event of input {number}"))[0]

    def wait_integrations(self, number: int) -> list[IntegrationEvent]:
        """Wait for ``number`` events of clouds; return all."""

        def found(events: list[Event]) -> list[IntegrationEvent]:
            return [e for e in events if isinstance(e, IntegrationEvent)]

        return found(self.events.wait(lambda events: len(found(events)) >= number, f"{number} decided clouds"))


@contextmanager
def connected(service: Service, map_name: str = "site") -> Iterator[Feed]:
    """Wait until a service is ready; yield a session with it."""
    endpoints = service.ready()["endpoints"]
    with zenoh.open(peer_config(connect=endpoints)) as session:
        yield Feed(session, map_name)


@contextmanager
def running(directory: Path, **settings: Mapping[str, Any]) -> Iterator[tuple[Service, Feed]]:
    """Run a service; yield it and a session with it. It must stop in order, and its log must replay as equal."""
    with ExitStack() as stack:
        service = stack.enter_context(Service(directory, **settings))
        feed = stack.enter_context(connected(service))
        yield service, feed
        assert service.stop() == 0, service.err
        assert len(service.out) == 1, "stdout is for the ready line alone"
        code, verdict = replay(service.log)
        assert (code, verdict.split(":")[0]) == (0, "equal"), verdict


def replay(*arguments: Path | str) -> tuple[int, str]:
    """Run `roughmap replay` in this process; return the exit code and the last line of output."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = run(["replay", *map(str, arguments)])
    return code, (out.getvalue().strip() or err.getvalue().strip()).splitlines()[-1]


@dataclass(frozen=True)
class Logged:
    """A message in the log."""

    topic: str
    data: bytes
    sequence: int
    log_time: int
    publish_time: int

    @property
    def event(self) -> Event:
        return decode_event(self.data)


def read_log(directory: Path) -> list[Logged]:
    """Return all messages of a folder's files in file order, by mcap's own reader; an open file may end anywhere."""
    found = []
    for path in sorted(directory.glob("*.mcap")):
        topics: dict[int, str] = {}
        with path.open("rb") as stream:
            try:
                for record in StreamReader(stream).records:
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message):
                        topic = topics[record.channel_id]
                        found.append(Logged(topic, record.data, record.sequence, record.log_time, record.publish_time))
            except EndOfFile:
                continue
    return found


def events_in(directory: Path) -> list[Event]:
    """Return the log's events in order."""
    return [message.event for message in read_log(directory) if message.topic.endswith("/events")]


def inputs_in(directory: Path) -> list[Logged]:
    """Return the log's inputs in order; the first has number 1."""
    return [message for message in read_log(directory) if message.topic.startswith("robots/")]
