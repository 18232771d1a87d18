"""What a fault is: what it makes of a robot's messages, and who must name it with which words."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from random import Random
from typing import Any, Literal

import walks_paths  # noqa: F401 - before what it makes importable
from walker import SENSORS, Effect, Message

from roughmap_schemas.kinds import Kind

MAP_SETTINGS: dict[str, Any] = {"max_new_tiles": 256}
"""Few tiles, so that a cloud of some thousand points can need more."""

Begins = Literal["before", "meanwhile", "first"]
"""When a fault begins: just before the doctor listens; while it does (a single event); with the robot's life."""


@dataclass(frozen=True)
class Names:
    """Who names a fault: regular expressions. All are empty where there is no fault.

    ``log``: "event" or "event reason" of a log line, then words of its text. ``health``: the sentence in `problems`, or
    in `recent` if the fault is not ``lasting``. ``doctor``: the text of a finding; ``advice``: its remedy and settings;
    by ``verdict``. ``of_sensor``: the subject is the sensor, else the robot. ``time_offset``: the right one, wherever
    one is advised.
    """

    log: tuple[str, str] | None = None
    health: str = ""
    doctor: str = ""
    advice: str = ""
    verdict: Literal["ok", "note", "wrong"] = "wrong"
    lasting: bool = True
    of_sensor: bool = True
    time_offset: float = 0.0


@dataclass(frozen=True)
class Fault:
    """A drawn fault. ``told``: its parameters, for the table. ``sensor``: the frame that it concerns, or none."""

    effect: Effect
    names: Names
    told: str = ""
    sensor: str = ""


@dataclass(frozen=True)
class FaultKind:
    """A kind of fault: how it is drawn, when it begins, the robot's settings, what the robot's scanners must be like.

    ``costs``: "sensors" if they may be problems too. ``ends``: whether the problem ends soon after the fault.
    """

    title: str
    draw: Callable[[Random], Fault]
    begins: Begins = "before"
    settings: Mapping[str, Any] = field(default_factory=dict)
    timed: bool | None = None
    costs: str = ""
    ends: bool = True


def of_odometry(change: Callable[[Message], list[Message]]) -> Effect:
    return lambda m: change(m) if m.kind is Kind.ODOMETRY else [m]


def of_clouds(sensor: str, change: Callable[[Message], list[Message]]) -> Effect:
    return lambda m: change(m) if m.sensor == sensor else [m]


def a_sensor(random: Random) -> str:
    return random.choice(SENSORS)


def table_of(sensor: str) -> str:
    """The head of the sensor's table in a remedy, as a regular expression."""
    return r'\[[^]]*sensors\."os\.lidar"\]' if sensor == "os.lidar" else r"\[[^]]*sensors\.rear\]"


def name_of(sensor: str) -> str:
    return sensor.replace(".", r"\.")
