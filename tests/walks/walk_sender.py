"""The robots of a walk: each with its fault and what was told of it, and the thread that sends their messages."""

import heapq
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any

import walks_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import WAIT_S
from walk_fault import MAP_SETTINGS, Fault, FaultKind
from walk_faults import FAULTS
from walker import SENSORS, Message, Walker

from roughmap_schemas.kinds import Kind


@dataclass
class Told:
    """Who named a fault, in seconds after it began, or for doctor after it could be seen; None: nobody yet."""

    log: float | None = None
    health: float | None = None
    doctor: float | None = None
    ended: float | None = None
    """When the health was well again, after the fault's end."""
    pasted: float | None = None
    """When all was mapped by another service, with the settings that doctor gave."""
    settings: str = ""
    """These settings."""
    wrong: list[str] = field(default_factory=list)
    """What else was told, and must not be."""
    said: dict[str, str] = field(default_factory=dict)
    """The words."""


@dataclass
class Walk:
    """One robot of a batch. ``on``: whether its fault is; times are wall seconds, 0 while it has not begun."""

    name: str
    fault: Fault
    walker: Walker
    told: Told = field(default_factory=Told)
    on: bool = False
    silent: bool = False
    begun: float = 0.0
    ended: float = 0.0
    integrated: int = 0

    @property
    def kind(self) -> FaultKind:
        return FAULTS[self.name]

    @property
    def robot(self) -> str:
        return f"robot {self.name}"

    @property
    def subject(self) -> str:
        """Under which a problem must be listed."""
        names = self.fault.names
        if not names.of_sensor:
            return self.robot
        return f"{self.robot} sensor {self.fault.sensor or SENSORS[0]}"

    def begin(self) -> None:
        self.begun, self.on, self.silent = time.time(), True, False

    def missing(self) -> list[str]:
        """Who has not named it."""
        names, told, walk_ends = self.fault.names, self.told, self.kind.ends
        who = {
            "log": names.log and told.log is None,
            "health": names.health and told.health is None,
            "doctor": names.doctor and told.doctor is None,
            "end": names.health and walk_ends and told.ended is None,
        }
        return [one for one, lacks in who.items() if lacks]


def draw(name: str, seed: int, lane: float = 0.0) -> Walk:
    """Draw a robot with a fault of this kind."""
    random = Random(f"{seed} {name}")
    kind = FAULTS[name]
    return Walk(name, kind.draw(random), Walker.draw(name, lane, random, timed=kind.timed))


class Sender(threading.Thread):
    """Sends the messages of all robots in real time, each as its fault makes it while that is on."""

    def __init__(self, session: zenoh.Session, walks: Sequence[Walk]) -> None:
        super().__init__(daemon=True)
        self._session = session
        self._walks = walks
        self._stopped = threading.Event()
        self._numbers: Counter[tuple[str, Kind]] = Counter()
        self.late = 0.0
        """Most seconds that a message was sent too late: this machine's own."""

    def run(self) -> None:
        born_ns, born = time.time_ns(), time.monotonic()
        streams = [self._stream(walk, born_ns) for walk in self._walks]
        for due, walk, message in heapq.merge(*streams, key=lambda sent: sent[0]):
            left = born + due - time.monotonic()
            if self._stopped.wait(max(left, 0.0)):
                return
            self.late = max(self.late, -left)
            if walk.silent:
                continue
            for one in walk.fault.effect(message) if walk.on else [message]:
                self._send(walk.name, one)

    def _stream(self, walk: Walk, born_ns: int) -> Iterator[tuple[float, Walk, Message]]:
        return ((due, walk, message) for due, message in walk.walker.messages(born_ns))

    def _send(self, robot: str, message: Message) -> None:
        number = self._numbers[robot, message.kind] = self._numbers[robot, message.kind] + 1
        if message.lost:
            return
        self._session.put(
            f"robots/{robot}/{message.kind.value}", message.payload(), attachment=number.to_bytes(8, "little"),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )  # fmt: skip

    def stop(self) -> None:
        """End it."""
        self._stopped.set()
        self.join(WAIT_S)


def settings(names: Sequence[str]) -> dict[str, Mapping[str, Any]]:
    """The service's settings for robots with these faults; TOML keys with a dot are quoted."""
    quoted = {'"os.lidar"' if frame == "os.lidar" else frame: frame for frame in SENSORS}
    rear = {"translation": [-0.2, 0.0, 1.0], "rotation": [0.0, 0.0, 1.0, 0.0]}
    front = {"translation": [0.2, 0.0, 1.0]}
    errors = {"range_sigma": 0.02, "beam_sigma": 0.0005, "min_range": 0.3}
    robots = {}
    for name in names:
        given = FAULTS[name].settings.get("sensors", {})
        robots[name] = {"sensors": {key: given[frame] for key, frame in quoted.items() if frame in given}}
    return {
        "map": {"cell_size": 0.1, **MAP_SETTINGS},
        "sensors": {'"os.lidar"': {**errors, **front}, "rear": {**errors, **rear}},
        "robots": {name: given for name, given in robots.items() if given["sensors"]},
        "service": {"log_format": "json"},
    }
