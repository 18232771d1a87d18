"""Counts and measures what robots publish while `roughmap doctor` listens."""

import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
import zenoh

from roughmap_schemas import Cloud, Keys, MessageFault, Odometry, check_encoding
from roughmap_schemas.kinds import Kind
from roughmap_service.inputs.subscriptions import ENCODINGS
from roughmap_service.run.decoding import decode
from roughmap_service.run.placing import span
from roughmap_service.run.settings import Settings

MAX_KEPT = 20_000
"""Stamps kept of one robot's poses or clouds."""

MAX_FRAMES = 64
"""Frames counted separately for one robot."""


@dataclass
class Stream:
    """One robot's messages of one kind.

    ``times`` holds (arrival on the monotonic clock in s, first and last stamp in ns, by how much the last stamp is
    behind this machine's clock in s).
    """

    number: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    unnumbered: int = 0
    times: deque[tuple[float, int, int, float]] = field(default_factory=lambda: deque(maxlen=MAX_KEPT))

    @property
    def rate(self) -> float:
        """Messages per second, between the first and the last."""
        if len(self.times) < 2:
            return 0.0
        return (len(self.times) - 1) / max(self.times[-1][0] - self.times[0][0], 1e-9)

    @property
    def behind(self) -> float:
        """Seconds by which the stamps are behind this machine's clock (median)."""
        return float(np.median([behind for *_, behind in self.times])) if self.times else 0.0


@dataclass
class Heard:
    """What one robot published."""

    clouds: Stream = field(default_factory=Stream)
    poses: Stream = field(default_factory=Stream)
    transforms: Stream = field(default_factory=Stream)
    cloud_frames: Counter[str] = field(default_factory=Counter)
    timeless: Counter[str] = field(default_factory=Counter)
    """Clouds without per-point times, by frame."""
    points: int = 0
    pose_frames: Counter[str] = field(default_factory=Counter)
    child_frames: set[str] = field(default_factory=set)
    unknown_covariance: int = 0
    bad_covariance: int = 0


class Traffic:
    """Collects what robots publish, in `robots` by name."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self.robots: dict[str, Heard] = {}
        self.ended = 0.0

    def listen(self, session: zenoh.Session, keys: Keys, seconds: float) -> None:
        """Collect what is published within ``seconds``."""
        subscribers = []
        for kind, key, parse in (
            (Kind.POINTS, keys.points_any, keys.parse_points),
            (Kind.ODOMETRY, keys.odometry_any, keys.parse_odometry),
            (Kind.TRANSFORM, keys.transform_any, keys.parse_transform),
        ):

            def take(sample: zenoh.Sample, kind: Kind = kind, parse: object = parse) -> None:
                try:
                    robot = parse(str(sample.key_expr))  # type: ignore[operator]
                except MessageFault:
                    return  # not a robot's key
                attachment = sample.attachment
                numbered = attachment is not None and len(attachment) == 8
                self.take(kind, robot, sample.payload.to_bytes(), str(sample.encoding), numbered=numbered)

            subscribers.append(session.declare_subscriber(key, take))
        threading.Event().wait(seconds)
        for subscriber in subscribers:
            subscriber.undeclare()
        self.ended = time.monotonic()

    def take(self, kind: Kind, robot: str, payload: bytes, encoding: str, *, numbered: bool) -> None:
        """Count one message."""
        arrival, now_ns = time.monotonic(), time.time_ns()
        with self._lock:
            if robot not in self.robots and len(self.robots) >= self._settings.max_robots:
                return
            heard = self.robots.setdefault(robot, Heard())
            streams = {Kind.POINTS: heard.clouds, Kind.ODOMETRY: heard.poses, Kind.TRANSFORM: heard.transforms}
            stream = streams[kind]
            stream.number += 1
            stream.unnumbered += not numbered
            try:
                check_encoding(encoding, ENCODINGS[kind])
                content = decode(kind, payload, self._settings)
            except MessageFault as fault:
                stream.faults[f"{fault.code}: {fault.message}" if len(stream.faults) < MAX_FRAMES else "others"] += 1
                return
            first, last = span(content) if isinstance(content, Cloud) else (content.stamp_ns, content.stamp_ns)
            stream.times.append((arrival, first, last, (now_ns - last) / 1e9))
            if isinstance(content, Cloud):
                heard.points += len(content.points)
                self._count(heard.cloud_frames, content.frame_id)
                if content.offsets_ns is None:
                    self._count(heard.timeless, content.frame_id)
            elif isinstance(content, Odometry):
                self._count(heard.pose_frames, content.frame_id)
                heard.bad_covariance += content.covariance_fault
                heard.unknown_covariance += content.covariance is None and not content.covariance_fault
            elif content.parent_frame_id == self._settings.frame_id and len(heard.child_frames) < MAX_FRAMES:
                heard.child_frames.add(content.child_frame_id)

    @staticmethod
    def _count(counts: Counter[str], frame: str) -> None:
        if frame in counts or len(counts) < MAX_FRAMES:
            counts[frame] += 1


def pose_waits(heard: Heard, ended: float) -> tuple[list[float], int]:
    """Return for each cloud how many seconds later the pose arrived that covers its end, and how many had none.

    A cloud that arrived less than 1 s before ``ended``, the end of listening, does not count as one without a pose.
    """
    covered: list[tuple[float, int]] = []  # arrivals at which the newest stamp rose
    for arrival, _, stamp, _ in heard.poses.times:
        if not covered or stamp > covered[-1][1]:
            covered.append((arrival, stamp))
    stamps = np.array([stamp for _, stamp in covered], np.int64)
    waits, without = [], 0
    for arrival, _, last, _ in heard.clouds.times:
        at = int(np.searchsorted(stamps, last))
        if at < len(covered):
            waits.append(max(covered[at][0] - arrival, 0.0))
        elif ended - arrival > 1.0:
            without += 1
    return waits, without


def largest_gap(stream: Stream) -> float:
    """Return the largest difference of two neighbouring stamps, in s."""
    stamps = np.unique(np.array([last for _, _, last, _ in stream.times], np.int64))
    return float(np.diff(stamps).max()) / 1e9 if len(stamps) > 1 else 0.0
