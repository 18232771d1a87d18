"""One recording, sent to a service in many ways: at other speeds, with a pause, poses before clouds and after them.

Nothing of it may be lost to a rule about time, and the map must be the same to the bit.
"""

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import numpy.typing as npt
import walks_paths  # noqa: F401 - before what it makes importable
import zenoh
from net import WAIT_S, Gathered
from processes import T0, Service
from walk_trial import connected_to
from walker import SENSORS, Message, Walker

from roughmap_client import RoughMapClient
from roughmap_client.session import ask
from roughmap_schemas import Event, IntegrationEvent, decode_event
from roughmap_schemas.kinds import Kind

ROBOT = "rover"

PAUSE_S = 3.0

TILE_M = 6.4

SETTINGS: dict[str, dict[str, Any]] = {
    # The scanners look to the left and to the right of a tile's edge, along which the robot drives: they share no tile,
    # so it does not matter which of them comes first.
    "sensors": {
        '"os.lidar"': {"range_sigma": 0.02, "translation": [0.0, 0.0, 1.0], "rotation": [0.0, 0.0, 0.5**0.5, 0.5**0.5]},
        "rear": {"range_sigma": 0.02, "translation": [0.0, 0.0, 1.0], "rotation": [0.0, 0.0, -(0.5**0.5), 0.5**0.5]},
    },
    # Clouds wait over the pause, and for poses that come after all clouds; poses are kept until all clouds have come.
    "input": {"max_wait": 60.0, "pose_history": 60.0},
}  # fmt: skip

LAYERS = ("mean_height", "min_height", "max_height", "std_dev", "mean_variance", "count", "weight", "confidence_factor")


@dataclass(frozen=True)
class Recorded:
    """A message and the second of the recording at which it came."""

    at: float
    kind: Kind
    payload: bytes


def record(seed: int, seconds: float) -> list[Recorded]:
    """What a robot sends in that time; its odometry goes on until the last cloud has its poses."""
    walker = Walker.draw(ROBOT, 2 * TILE_M, Random(f"{seed} recording"))

    def before(sent: tuple[float, Message]) -> bool:
        return sent[0] < seconds + 1.0

    return [
        Recorded(at, message.kind, message.payload())
        for at, message in takewhile(before, walker.messages(T0))
        if message.kind is Kind.ODOMETRY or at < seconds
    ]  # fmt: skip


Timed = Iterator[tuple[float, Recorded]]
"""Messages in the order in which they are sent, each with the second of sending."""


def at_speed(speed: float) -> Any:
    """As they came, so many times as fast."""
    return lambda recording: ((one.at / speed, one) for one in recording)


def paused(recording: Sequence[Recorded]) -> Timed:
    """As they came, with a pause in the middle, at four times the speed."""
    middle = recording[-1].at / 2
    return ((one.at / 4 + (PAUSE_S if one.at > middle else 0.0), one) for one in recording)


def flat_out(recording: Sequence[Recorded]) -> Timed:
    """As they came, without a wait."""
    return ((0.0, one) for one in recording)


def poses_first(recording: Sequence[Recorded]) -> Timed:
    """All poses, then all clouds."""
    return flat_out(sorted(recording, key=lambda one: one.kind is Kind.POINTS))


def clouds_first(recording: Sequence[Recorded]) -> Timed:
    """All clouds, then all poses."""
    return flat_out(sorted(recording, key=lambda one: one.kind is not Kind.POINTS))


SLOW = {"0.2 x": at_speed(0.2)}
QUICK = {
    "1 x": at_speed(1.0), "10 x": at_speed(10.0), "flat out": flat_out, "paused": paused,
    "poses first": poses_first, "clouds first": clouds_first, "1 x again": at_speed(1.0),
}  # fmt: skip
"""Two services take them, since the slow way takes as long as all others."""


@dataclass(frozen=True)
class Fed:
    """What came of one way: the clouds sent, what became of them, of points and poses, and the map."""

    way: str
    clouds: int
    outcomes: Counter[str]
    lost: dict[str, int]
    layers: npt.NDArray[np.float64]


def feed(folder: Path, recording: Sequence[Recorded], ways: dict[str, Any]) -> list[Fed]:
    """Send a recording in these ways, one after the other, to one service that is reset before each."""
    found = []
    with ExitStack() as stack:
        service, _, session = stack.enter_context(connected_to(Service(folder, **SETTINGS)))
        client = RoughMapClient("site", session=session, timeout=WAIT_S)
        for way, order in ways.items():
            before = client.status()
            events: Gathered[Event] = Gathered()
            subscriber = session.declare_subscriber(
                "maps/site/events", lambda sample, to=events: to(decode_event(sample.payload.to_bytes()))
            )
            client.status()
            send(session, order(recording))
            clouds = sum(one.kind is Kind.POINTS for one in recording)

            def decided(events: list[Event]) -> list[IntegrationEvent]:
                return [event for event in events if isinstance(event, IntegrationEvent)]

            outcomes = [e.outcome for e in decided(events.wait(lambda e: len(decided(e)) >= clouds, f"all of {way}"))]
            subscriber.undeclare()
            after = client.status()
            lost = {
                f"{what} {reason}": number - getattr(before, what).rejected.get(reason, 0)
                for what in ("clouds", "points", "poses")
                for reason, number in getattr(after, what).rejected.items()
            } | {
                f"refused {reason}": number - before.refused.get(reason, 0) for reason, number in after.refused.items()
            }
            region = client.region((10.0, -10.0, 50.0, 30.0), LAYERS, dtype="f8")
            layers = np.stack([region[name] for name in LAYERS])
            found.append(Fed(way, clouds, Counter(map(str, outcomes)), {k: n for k, n in lost.items() if n}, layers))
            ask(session, "maps/site/control/reset", timeout=WAIT_S).single()
        assert service.stop() == 0, service.err[-3:]
    return found


def send(session: zenoh.Session, messages: Timed) -> None:
    """Publish them at their times."""
    begun = time.monotonic()
    for at, one in messages:
        if (left := begun + at - time.monotonic()) > 0.0:
            time.sleep(left)
        session.put(f"robots/{ROBOT}/{one.kind.value}", one.payload, congestion_control=zenoh.CongestionControl.BLOCK)


def differences(ways: Sequence[Fed]) -> list[str]:
    """What was lost, and which maps differ from the first one."""
    found = []
    for fed in ways:
        if fed.outcomes != {"integrated": fed.clouds} or fed.lost:
            found.append(f"{fed.way}: of {fed.clouds} clouds became {dict(fed.outcomes)}; lost: {fed.lost}")
        known = np.isfinite(fed.layers[0])
        if not known.any():
            found.append(f"{fed.way}: the map is empty")
        if not np.array_equal(fed.layers, ways[0].layers, equal_nan=True):
            found.append(f"{fed.way}: its map differs from that of {ways[0].way}")
    return found


assert SENSORS == ("os.lidar", "rear")
