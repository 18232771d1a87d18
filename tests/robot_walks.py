"""A simulated robot's messages in the order of their arrival, with clocks that may be wrong, and where it truly was."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from service_tools import LEVEL, PRECISE, T0, LoggedRun

from roughmap_schemas import Config, IntegrationEvent, decode_event, encode_cloud, encode_odometry
from roughmap_schemas.kinds import Kind
from roughmap_service.inputs.queue import InputMessage

BEGUN_NS = 4_000_000_000 * 10**9
"""Wall time at which robots begin to send: later than any event is logged, as log times only rise."""

Clock = Callable[[float], float]
"""From the true time in s to the time that a clock shows."""


class Message(NamedTuple):
    """A message: when it arrives, what it is, its stamp in s, where the robot was, whether it is wild."""

    arrival: float
    kind: Kind
    stamp: float
    place: float
    frame: str = ""
    wild: bool = False


@dataclass(frozen=True)
class Drive:
    """A robot that walks along x at most at ``speed`` m/s for ``seconds``; rates in Hz, latencies in s.

    ``clock`` is the one of all its stamps, ``scan_clock`` the scanner's if it has its own. Of the odometry, and of the
    scans, a share ``wild`` has a stamp that is off by ``wild_by``. Odometry is late by up to ``jitter``, and a share
    ``lost`` of all messages is lost.
    """

    seconds: float = 12.0
    speed: float = 1.0
    odometry_hz: float = 20.0
    scan_hz: float = 10.0
    odometry_latency: float = 0.005
    scan_latency: float = 0.12
    clock: Clock = lambda t: t
    scan_clock: Clock | None = None
    jitter: float = 0.0
    wild: float = 0.0
    wild_by: float = 3600.0
    wild_scans: float = 0.0
    lost: float = 0.0

    def messages(self, seed: int = 0) -> list[Message]:
        """Return the messages in order of arrival."""
        random = np.random.default_rng(seed)
        knots = np.arange(0.0, self.seconds + 2.0)
        speeds = self.speed * random.uniform(-1.0, 1.0, len(knots))
        if not seed:
            speeds[:] = self.speed
        places = np.concatenate([[0.0], np.cumsum(speeds)[:-1]])
        found = []
        for k in range(round(self.seconds * self.odometry_hz)):
            t = k / self.odometry_hz
            arrival = t + self.odometry_latency + random.uniform(0.0, self.jitter)
            wild = random.random() < self.wild
            stamp = self.clock(t) + (self.wild_by if wild else 0.0)
            found.append(Message(arrival, Kind.ODOMETRY, stamp, float(np.interp(t, knots, places)), "", wild))
        for k in range(round(self.seconds * self.scan_hz)):
            t = k / self.scan_hz + 0.003
            wild = random.random() < self.wild_scans
            stamp = (self.scan_clock or self.clock)(t) + (self.wild_by if wild else 0.0)
            found.append(
                Message(t + self.scan_latency, Kind.POINTS, stamp, float(np.interp(t, knots, places)), "lidar", wild)
            )
        return sorted(one for one in found if random.random() >= self.lost)


@dataclass
class Outcome:
    """What became of the clouds: each one's outcome and, if integrated, how far from the truth it was placed, in m."""

    outcomes: list[str]
    errors: list[float]

    @property
    def worst(self) -> float:
        """The largest error; 0 if none was placed."""
        return max(self.errors, default=0.0)


def play(messages: list[Message], directory: Path, settings: Config | None = None) -> Outcome:
    """Send the messages to a live run at their times, and return what it decided."""
    truth: dict[int, Message] = {}
    with LoggedRun(directory, settings) as live:
        for one in messages:
            live.decide(one.arrival)
            stamp_ns = T0 + round(one.stamp * 1e9)
            if one.kind is Kind.POINTS:
                payload = encode_cloud(np.array([[1.0, 0.0, -0.5]]) + len(truth) * 1e-6, stamp_ns, one.frame)
            else:
                payload = encode_odometry(stamp_ns, "map", (one.place, 0.0, 1.0), LEVEL, PRECISE)
            received = BEGUN_NS + round(one.arrival * 1e9)
            number = live.live.accept(InputMessage(one.kind, "rover", payload, received, one.arrival), one.arrival)
            if number is not None:
                truth.setdefault(number, one)
        end = messages[-1].arrival
        for late in np.arange(0.1, 5.0, 0.1):
            live.decide(end + late)
    # Some clouds are decided while a pose is accepted, so look at what was published.
    decided = [e for e in map(decode_event, live.published) if isinstance(e, IntegrationEvent)]
    errors = []
    for event in decided:
        if event.outcome != "integrated":
            continue
        cloud = truth[event.input]
        line = [truth[odometry] for odometry, _ in event.poses]
        at = np.interp(cloud.stamp, [p.stamp for p in line], [p.place for p in line])
        assert all(a.stamp < b.stamp for a, b in pairwise(line))
        if not cloud.wild:
            errors.append(abs(float(at) - cloud.place))
    return Outcome([str(e.outcome) for e in decided], errors)
