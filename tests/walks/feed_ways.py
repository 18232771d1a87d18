"""One recording, sent to a service in many ways: at other speeds, with a pause, poses before clouds and after them.

Nothing of it may be lost to a rule about time, and the map must be the same to the bit.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
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
from walker import Message, Walker

from roughmap_client import RoughMapClient
from roughmap_client.session import ask
from roughmap_schemas import Event, IntegrationEvent, MapStatus, decode_event
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

TAIL_S = 0.2
"""Odometry after the last cloud: a pose every 0.05 s or more often, late by 0.03 s at most."""

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
        return sent[0] < seconds + TAIL_S

    return [
        Recorded(at, message.kind, message.payload())
        for at, message in takewhile(before, walker.messages(T0))
        if message.kind is Kind.ODOMETRY or at < seconds
    ]  # fmt: skip


Timed = Iterator[tuple[float, Recorded]]
"""Messages in the order in which they are sent, each with the second of sending."""

Way = Callable[[Sequence[Recorded]], Timed]


def at_speed(speed: float) -> Way:
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


SLOW: dict[str, Way] = {"0.2 x": at_speed(0.2)}
QUICK: dict[str, Way] = {
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
    lost: Counter[str]
    layers: npt.NDArray[np.float64]


def feed(folder: Path, recording: Sequence[Recorded], ways: dict[str, Way]) -> list[Fed]:
    """Send a recording in these ways, one after the other, to one service that is reset before each."""
    found = []
    with ExitStack() as stack:
        service, _, session = stack.enter_context(connected_to(Service(folder, **SETTINGS)))
        client = RoughMapClient("site", session=session, timeout=WAIT_S)
        events: Gathered[Event] = Gathered()
        session.declare_subscriber("maps/site/events", lambda sample: events(decode_event(sample.payload.to_bytes())))
        clouds, sent = sum(one.kind is Kind.POINTS for one in recording), 0
        for way, order in ways.items():
            before = losses(client.status())
            send(session, order(recording))
            sent += clouds
            outcomes = events.wait(lambda all_of, sent=sent: len(_outcomes(all_of)) >= sent, f"all clouds, {way}")
            region = client.region((10.0, -10.0, 50.0, 30.0), LAYERS, dtype="f8")
            layers = np.stack([region[name] for name in LAYERS])
            found.append(
                Fed(way, clouds, Counter(_outcomes(outcomes)[-clouds:]), losses(client.status()) - before, layers)
            )
            ask(session, "maps/site/control/reset", timeout=WAIT_S).single()
        assert service.stop() == 0, service.err[-3:]
    return found


def feed_all(folder: Path, recording: Sequence[Recorded]) -> list[Fed]:
    """Send a recording in all ways, the slow one beside the others."""
    with ThreadPoolExecutor(2) as pool:
        parts = [pool.submit(feed, folder / name, recording, ways) for name, ways in (("quick", QUICK), ("slow", SLOW))]
        return [fed for part in parts for fed in part.result()]


def losses(status: MapStatus) -> Counter[str]:
    """All that did not come to the map, by what and why."""
    counts = {"clouds": status.clouds.rejected, "points": status.points.rejected, "poses": status.poses.rejected}
    counts["refused"] = status.refused
    return Counter({f"{what} {reason}": n for what, by_reason in counts.items() for reason, n in by_reason.items()})


def _outcomes(events: Sequence[Event]) -> list[str]:
    return [str(event.outcome) for event in events if isinstance(event, IntegrationEvent)]


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
            found.append(f"{fed.way}: of {fed.clouds} clouds became {dict(fed.outcomes)}; lost: {dict(fed.lost)}")
        known = np.isfinite(fed.layers[0])
        if not known.any():
            found.append(f"{fed.way}: the map is empty")
        if not np.array_equal(fed.layers, ways[0].layers, equal_nan=True):
            found.append(f"{fed.way}: its map differs from that of {ways[0].way}")
    return found
