"""Publishes the messages of robots at the pace at which they were made."""

import heapq
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas.encodings import FRAME_TRANSFORM, ODOMETRY, POINT_CLOUD
from roughmap_schemas.faults import ReportedError
from roughmap_schemas.keys import TEMPLATES
from roughmap_service.simulation.rover import Kind, Message

AHEAD = 64
"""Messages made ahead: about a second, so that making a sweep never delays a pose."""

NANOSECONDS = 1_000_000_000

ENCODINGS: dict[Kind, str] = {"points": POINT_CLOUD, "odometry": ODOMETRY, "transform": FRAME_TRANSFORM}


@dataclass
class Published:
    """What has been published so far; `late_s` is the longest delay behind the schedule."""

    clouds: int = 0
    poses: int = 0
    bytes: int = 0
    last_stamp_ns: int = 0
    late_s: float = 0.0


class NobodyListens(ReportedError):
    """No service subscribed to the robots' messages in time."""


class RoverPublisher:
    """Publishers of several robots on one session; a context manager.

    When the network can't keep up, they wait (congestion control BLOCK; Zenoh's default drops without a word). That
    loses nothing unless a peer hangs for seconds; the service then counts the gap from `message_seq`.
    """

    def __init__(self, session: zenoh.Session, robots: Iterable[str]) -> None:
        self.published = Published()
        self._sequence: dict[tuple[str, Kind], int] = {}
        self._publishers: dict[tuple[str, Kind], zenoh.Publisher] = {}
        for robot in robots:
            for kind, encoding in ENCODINGS.items():
                self._sequence[robot, kind] = 0
                self._publishers[robot, kind] = session.declare_publisher(
                    TEMPLATES[kind].format(robot=robot),
                    encoding=encoding,
                    congestion_control=zenoh.CongestionControl.BLOCK,
                    # Poses overtake clouds: they are small, and clouds wait for them.
                    priority=zenoh.Priority.DATA if kind == "points" else zenoh.Priority.DATA_HIGH,
                )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for publisher in self._publishers.values():
            publisher.undeclare()

    def wait_for_listeners(self, seconds: float) -> None:
        """Wait until every robot's clouds and poses have a subscriber; NobodyListens after `seconds`."""
        deadline = time.monotonic() + seconds
        for (_, kind), publisher in self._publishers.items():
            if kind == "transform":  # no robot must send them
                continue
            heard = threading.Event()

            def on_change(status: zenoh.MatchingStatus, heard: threading.Event = heard) -> None:
                if status.matching:
                    heard.set()

            listener = publisher.declare_matching_listener(on_change)
            try:
                if not _is_heard(publisher) and not heard.wait(max(0.0, deadline - time.monotonic())):
                    raise NobodyListens(f"nobody subscribes to {publisher.key_expr} within {seconds:g} s")
            finally:
                listener.undeclare()

    def put(self, message: Message) -> None:
        """Publish one message with its `message_seq` (8 bytes little-endian, one count per key)."""
        number = self._sequence[message.robot, message.kind]
        self._publishers[message.robot, message.kind].put(message.payload, attachment=number.to_bytes(8, "little"))
        self._sequence[message.robot, message.kind] = number + 1
        self.published.clouds += message.kind == "points"
        self.published.poses += message.kind == "odometry"
        self.published.bytes += len(message.payload)
        self.published.last_stamp_ns = max(self.published.last_stamp_ns, message.stamp_ns)

    def play(
        self,
        messages: Iterable[Message],
        *,
        rate: float = 1.0,
        stop: threading.Event | None = None,
        on_put: Callable[[Published], None] | None = None,
    ) -> Published:
        """Publish `messages`, each when it is due, at `rate` times real time; 0 is as fast as possible.

        Returns early when `stop` is set. Messages are made ahead in another thread.
        """
        stop = threading.Event() if stop is None else stop
        begun: float | None = None
        first_ns = 0
        for message in _ahead(messages, stop):
            if begun is None:
                begun, first_ns = time.monotonic(), message.due_ns
            if rate > 0:
                late = time.monotonic() - begun - (message.due_ns - first_ns) / NANOSECONDS / rate
                if late < 0 and stop.wait(-late):
                    break
                self.published.late_s = max(self.published.late_s, late)
            self.put(message)
            if on_put is not None:
                on_put(self.published)
        return self.published


def _is_heard(publisher: zenoh.Publisher) -> bool:
    """Tell whether there is a subscriber. The type stubs say bool; the library returns an object with it."""
    return bool(getattr(publisher.matching_status, "matching", publisher.matching_status))


def merged(streams: Iterable[Iterator[Message]]) -> Iterator[Message]:
    """Merge the messages of several robots, in the order of `due_ns`."""
    return heapq.merge(*streams, key=lambda message: message.due_ns)


def _ahead(messages: Iterable[Message], stop: threading.Event) -> Iterator[Message]:
    """Yield `messages`, made in another thread, up to `AHEAD` of them in advance."""
    made: queue.Queue[Message | BaseException | None] = queue.Queue(AHEAD)
    done = threading.Event()

    def offer(item: Message | BaseException | None) -> bool:
        while not (stop.is_set() or done.is_set()):
            try:
                made.put(item, timeout=0.1)
            except queue.Full:
                continue
            return True
        return False

    def make() -> None:
        try:
            for message in messages:
                if not offer(message):
                    return
            offer(None)
        except BaseException as error:  # noqa: BLE001  # raised again by the consumer
            offer(error)

    maker = threading.Thread(target=make, name="rover", daemon=True)
    maker.start()
    try:
        while not stop.is_set():
            try:
                item = made.get(timeout=0.1)
            except queue.Empty:
                continue
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        done.set()
        maker.join()
