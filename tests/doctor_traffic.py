"""A robot's traffic as `roughmap doctor` hears it: messages with their arrivals, right or with a fault."""

import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

from roughmap_schemas import encode_odometry, encode_transform
from roughmap_schemas.config import Config
from roughmap_schemas.geometry import write_stamp
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.robots import judge
from roughmap_service.cli.doctor.traffic import Message, Traffic
from roughmap_service.inputs.subscriptions import ENCODINGS
from roughmap_service.run.settings import Settings

NOW = 1_750_000_000 * 10**9
"""When listening begins, in ns."""

LEVEL = (0.0, 0.0, 0.0, 1.0)
GOOD = np.eye(6) * 1e-4
SENSORS = {"lidar": {"range_sigma": 0.02, "min_range": 0.3}}

TYPES = {"<i4": 6, "<u4": 5, "<f4": 7, "<f8": 8}

Placed = tuple[Any, Any]
"""A position and a rotation."""


def ground(number: int = 20) -> np.ndarray:
    """Flat ground in front of a scanner 1 m above it."""
    x, y = np.meshgrid(np.linspace(1.0, 5.0, number), np.linspace(-2.0, 2.0, number))
    return np.stack([x, y, np.full_like(x, -1.0)], -1).reshape(-1, 3)


def message(kind: Kind, payload: bytes, arrival_s: float, robot: str = "r1", **more: Any) -> Message:
    """A message that arrives so many seconds after listening began."""
    encoding = more.pop("encoding", "") or ENCODINGS[kind]
    return Message(kind, robot, payload, encoding, NOW + round(arrival_s * 1e9), **more)


def timed_cloud(points: np.ndarray, stamp_ns: int, frame: str, name: str, times: np.ndarray) -> bytes:
    """A cloud whose points have times in a field of any name and type."""
    layout = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, times.dtype.newbyteorder("<"))])
    packed = np.empty(len(points), layout)
    for axis, values in zip("xyz", points.T, strict=True):
        packed[axis] = values
    packed[name] = times
    cloud = PointCloud(frame_id=frame, point_stride=layout.itemsize, data=packed.tobytes())
    write_stamp(cloud, stamp_ns)
    for field_name, (kind, offset, *_) in layout.fields.items():
        cloud.fields.append(PackedElementField(name=field_name, offset=offset, type=TYPES[kind.str]))
    return bytes(cloud.SerializeToString())


@dataclass
class Drive:
    """A robot that drives straight on at 1 m/s for some seconds, with one scanner; all can be overridden.

    A link keeps the order: a message arrives no earlier than the one before. Functions of time get seconds since
    listening began; ``n`` counts poses and clouds. ``pose_stamps`` and ``cloud_stamps`` return stamps in ns. The field
    ``time_field`` holds the points' times, as ``point_times`` makes them of the cloud's stamp and of seconds after it.
    """

    robot: str = "r1"
    seconds: float = 8.0
    odometry_hz: float = 50.0
    scan_hz: float = 10.0
    pose_latency: Callable[[int], float] = lambda _: 0.02
    cloud_latency: Callable[[int], float] = lambda _: 0.12
    motion: Callable[[float], Placed] = lambda t: ((t, 0.0, 0.0), LEVEL)
    covariance: Callable[[float], Any] = lambda _: GOOD
    frame: str = "map"
    pose_stamps: Callable[[float, int], int] = lambda t, _: NOW + round(t * 1e9)
    cloud_stamps: Callable[[float, int], int] = lambda t, _: NOW + round(t * 1e9)
    cloud_frame: str = "lidar"
    points: np.ndarray = field(default_factory=ground)
    sweep: float = 0.0999
    time_field: str = "t"
    point_times: Callable[[int, np.ndarray], np.ndarray] = lambda _, s: np.rint(s * 1e9).astype(np.uint32)
    transforms: Iterable[Message] = ()
    odometry: bool = True

    def messages(self) -> list[Message]:
        """All messages in the order of arrival."""
        found, arrival = list(self.transforms), 0.0
        for n in range(round(self.seconds * self.odometry_hz) * self.odometry):
            t = n / self.odometry_hz
            arrival = max(arrival, t + self.pose_latency(n))
            payload = encode_odometry(self.pose_stamps(t, n), self.frame, *self.motion(t), self.covariance(t))
            found.append(message(Kind.ODOMETRY, payload, arrival, self.robot, number=n))
        arrival, after = 0.0, np.linspace(0.0, self.sweep, len(self.points))
        for n in range(round(self.seconds * self.scan_hz)):
            t = n / self.scan_hz
            arrival = max(arrival, t + self.cloud_latency(n))
            stamp = self.cloud_stamps(t, n)
            payload = timed_cloud(self.points, stamp, self.cloud_frame, self.time_field, self.point_times(stamp, after))
            found.append(message(Kind.POINTS, payload, arrival, self.robot, number=n))
        return sorted(found, key=lambda one: one.arrival_ns)


def configuration(settings: dict[str, Any] | None = None) -> Config:
    """A configuration with one scanner, and these settings."""
    return Config.model_validate({"sensors": SENSORS, **(settings or {})})


def findings(
    messages: Iterable[Message], settings: dict[str, Any] | None = None, seconds: float = 8.0
) -> list[Finding]:
    """What the doctor says of messages that were heard in so many seconds."""
    config = configuration(settings)
    traffic = Traffic(Settings(config))
    for one in messages:
        if one.arrival_ns <= NOW + seconds * 1e9:
            traffic.take(one)
    traffic.ended_ns = NOW + round(seconds * 1e9)
    return judge(traffic, config, seconds)


def pasted(settings: dict[str, Any] | None, advice: str) -> dict[str, Any]:
    """The settings with a finding's lines in them."""
    return _merged({"sensors": SENSORS, **(settings or {})}, tomllib.loads(advice))


def _merged(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    both = dict(a)
    for name, value in b.items():
        both[name] = (
            _merged(both[name], value) if isinstance(both.get(name), dict) and isinstance(value, dict) else value
        )
    return both


def heard_transform(
    arrival_s: float, stamp_ns: int, child: str = "odom", parent: str = "map", x: float = 0.0
) -> Message:
    """A transform."""
    return message(Kind.TRANSFORM, encode_transform(stamp_ns, parent, child, (x, 0.0, 0.0), LEVEL), arrival_s, number=0)
