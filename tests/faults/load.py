"""Two robots that hand in poses and scans as fast as they are taken, a planner that asks, and who was promised what."""

import contextlib
import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh
from net import WAIT_S, peer_config
from processes import LEVEL, PRECISE, T0, Logged, Service, inputs_in

from roughmap_client import RoughMapClient, RoughMapError
from roughmap_schemas import MapStatus, Receipt, encode_cloud, encode_odometry

TENTH = 10**8
WINDOW = 12
"""Requests of one robot that are on their way at once."""

SETTINGS: dict[str, dict[str, object]] = {
    "map": {"memory_limit": "8MiB"},
    "log": {"checkpoint_interval": 0.1, "max_file_bytes": "1MiB", "flush_interval": 0.05},
    "store": {"snapshot_interval": 0.2},
    "input": {"max_wait": 0.3},
}
"""So that snapshots, rotation, checkpoints and spilling all happen within a second or two."""


SLOW_END_S = 60.0
"""The end of a service whose every call to the disk is recorded: on a busy machine it takes longer than by default."""


def settings(disk: Path, **more: dict[str, object]) -> dict[str, dict[str, object]]:
    """`SETTINGS` with log and store below ``disk``, and ``more`` over them."""
    given = {**SETTINGS, "log": {**SETTINGS["log"], "directory": str(disk / "log")}}
    given["store"] = {**given["store"], "path": str(disk / "store" / "map.db")}
    for name, values in more.items():
        given[name] = {**given.get(name, {}), **values}
    return given


def dense(number: int) -> bytes:
    """A cloud with a point in each cell of 64 tiles: 16 MiB."""
    x, y = np.meshgrid(0.1 * np.arange(512) + 0.05 + 51.2 * number, 0.1 * np.arange(512) + 0.05)
    return encode_cloud(np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32), T0 + number, "map")


Key = tuple[str, str, bytes]
"""What makes two messages the same: topic, robot and bytes would say the same thing."""


@dataclass
class Robot:
    """Drives on a circle; message 2k is the pose at k tenths of a second, 2k + 1 a scan between it and the next."""

    name: str
    seed: int
    points: int = 300
    next: int = 0
    unanswered: dict[int, tuple[str, bytes]] = field(default_factory=dict)
    receipts: dict[tuple[str, bytes], tuple[Receipt, int]] = field(default_factory=dict)
    """By kind and payload; with what ``clock`` said when it came."""

    def message(self, number: int) -> tuple[str, bytes]:
        """Kind and bytes of a message."""
        k, scan = divmod(number, 2)
        if scan:
            rng = np.random.default_rng((self.seed, number))
            points = rng.uniform([1.0, -4.0, -1.2], [8.0, 4.0, -0.8], (self.points, 3))
            return "points", encode_cloud(points, T0 + k * TENTH + TENTH // 2, "lidar")
        angle = 0.02 * k + self.seed
        position = (40.0 * math.cos(angle), 40.0 * math.sin(angle), 1.0)
        return "odometry", encode_odometry(T0 + k * TENTH, "map", position, LEVEL, PRECISE)


@dataclass
class Fleet:
    """Two robots and all that they were promised, over any number of starts of the service."""

    seed: int
    clock: Callable[[], int] = lambda: 0
    refused: Counter[str] = field(default_factory=Counter)
    answers: int = 0

    def __post_init__(self) -> None:
        self.robots = [Robot("r1", self.seed), Robot("r2", self.seed + 1)]
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)

    @property
    def promised(self) -> int:
        """Receipts so far."""
        with self._lock:
            return sum(len(robot.receipts) for robot in self.robots)

    def left(self) -> str:
        """What has no receipt, and what was said of it."""
        with self._lock:
            return f"{[(r.name, len(r.unanswered)) for r in self.robots]}, refused {dict(self.refused)}"

    def wait_promised(self, number: int, seconds: float = WAIT_S) -> bool:
        """Wait for so many receipts; False if they don't come in time."""
        with self._changed:
            return self._changed.wait_for(lambda: sum(len(robot.receipts) for robot in self.robots) >= number, seconds)

    @contextmanager
    def at_work(
        self, endpoints: list[str], *, asking: bool = True, most: int | None = None
    ) -> Iterator[threading.Event]:
        """While it lasts the robots hand in, first what has no receipt yet. ``most``: no more new messages of each.

        Gives an event that is set once nothing is left to hand in (with ``most``).
        """
        stop, done = threading.Event(), threading.Event()
        with zenoh.open(peer_config(connect=endpoints)) as session:
            left = [len(self.robots)]

            def run(robot: Robot) -> None:
                self._hand_in(robot, session, stop, most)
                left[0] -= 1
                if not left[0]:
                    done.set()

            threads = [threading.Thread(target=run, args=(robot,), daemon=True) for robot in self.robots]
            if asking:
                threads.append(threading.Thread(target=self._ask, args=(session, stop), daemon=True))
            for thread in threads:
                thread.start()
            try:
                yield done
            finally:
                stop.set()
                with self._changed:
                    self._changed.notify_all()
                for thread in threads:
                    thread.join(WAIT_S)

    def _hand_in(self, robot: Robot, session: zenoh.Session, stop: threading.Event, most: int | None) -> None:
        """What has no receipt goes first, and again until it has one; so no more than `WINDOW` have none."""
        last = None if most is None else robot.next + most
        way: set[int] = set()
        again = set(robot.unanswered)
        while not stop.is_set():
            with self._changed:
                waiting = sorted(set(robot.unanswered) - way)
                if len(way) >= WINDOW or (not waiting and robot.next == last):
                    if not robot.unanswered:
                        return
                    self._changed.wait(0.5)
                    continue
                if waiting and waiting[0] not in again:  # it was refused, or nobody answered
                    again.add(waiting[0])
                    self._changed.wait(0.1)
                    continue
                if waiting:
                    number = waiting[0]
                    again.discard(number)
                else:
                    number, robot.next = robot.next, robot.next + 1
                    robot.unanswered[number] = robot.message(number)
                way.add(number)
                kind, payload = robot.unanswered[number]
            self._send(robot, session, number, kind, payload, way)

    def _send(
        self, robot: Robot, session: zenoh.Session, number: int, kind: str, payload: bytes, way: set[int]
    ) -> None:
        def told(reply: zenoh.Reply) -> None:
            now = self.clock()
            with self._changed:
                if reply.ok is not None:
                    receipt = Receipt.model_validate_json(reply.ok.payload.to_bytes())
                    robot.receipts.setdefault((kind, payload), (receipt, now))
                    robot.unanswered.pop(number, None)
                elif reply.err is not None:
                    self.refused[reply.err.payload.to_bytes().decode()[:60].split(",")[0]] += 1

        def over() -> None:
            with self._changed:
                way.discard(number)
                self._changed.notify_all()

        with contextlib.suppress(zenoh.ZError):
            session.get(
                f"maps/site/ingest/{robot.name}/{kind}", zenoh.handlers.Callback(told, over), payload=payload,
                timeout=2.0, consolidation=zenoh.ConsolidationMode.NONE,
            )  # fmt: skip
            return
        over()

    def _ask(self, session: zenoh.Session, stop: threading.Event) -> None:
        with RoughMapClient("site", session=session, timeout=1.0) as client:
            while not stop.wait(0.02):
                with contextlib.suppress(RoughMapError):
                    client.tiles((-45.0, -45.0, 45.0, 45.0), ["mean_height", "slope"], level=1)
                    self.answers += 1

    def broken_promises(self, log: Path, before: int | None = None) -> list[str]:
        """What the log lacks of what was acknowledged (while ``clock`` said at most ``before``), or holds twice."""
        logged = inputs_in(log)
        found = [f"input of {topic} is logged {n} times" for (topic, _), n in _twice(logged)]
        for robot in self.robots:
            for (kind, payload), (receipt, when) in list(robot.receipts.items()):
                if before is not None and when > before:
                    continue
                there = logged[receipt.input - 1] if receipt.input <= len(logged) else None
                if there is None or there.data != payload or there.topic != f"robots/{robot.name}/{kind}":
                    found.append(f"{robot.name} has a receipt for input {receipt.input} ({kind}), which is gone")
        return found

    def invented(self, log: Path) -> list[str]:
        """Inputs of the log that no robot handed in."""
        sent = {
            (f"robots/{robot.name}/{kind}", payload)
            for robot in self.robots
            for kind, payload in [*robot.receipts, *robot.unanswered.values()]
        }
        return [
            f"{one.topic}: an input that nobody sent" for one in inputs_in(log) if (one.topic, one.data) not in sent
        ]


def _twice(logged: list[Logged]) -> list[tuple[tuple[str, bytes], int]]:
    return [item for item in Counter((one.topic, one.data) for one in logged).items() if item[1] > 1]


def status(service: Service) -> MapStatus:
    """How a service is, over a session of its own."""
    with zenoh.open(peer_config(connect=service.ready()["endpoints"])) as session:
        return RoughMapClient("site", session=session, timeout=WAIT_S).status()
