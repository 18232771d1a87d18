"""A simulated robot with two scanners that sends in real time: its messages, before a fault changes them."""

import heapq
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from random import Random

import numpy as np
import numpy.typing as npt
import walks_paths  # noqa: F401 - before what it makes importable
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from processes import LEVEL

from roughmap_schemas import encode_odometry
from roughmap_schemas.geometry import write_stamp
from roughmap_schemas.kinds import Kind

S = 10**9

SENSORS = ("os.lidar", "rear")
"""The frames of the scanners: one with a dot, which must be quoted in TOML."""

PRECISE = np.eye(6) * 1e-6

FIELD_TYPES = {
    "f4": PackedElementField.FLOAT32, "f8": PackedElementField.FLOAT64, "u4": PackedElementField.UINT32,
}  # fmt: skip

Floats = npt.NDArray[np.floating]
Times = Mapping[str, npt.NDArray[np.generic]]


@dataclass(frozen=True)
class Message:
    """A message on its way.

    ``made``: seconds of its robot's life when it was measured. ``stamp_ns``: what its stamp says. ``sensor``: the frame
    of the scanner that made it, whatever ``frame`` says; "" for odometry. ``times``: fields of the points. A ``lost``
    message takes a number and never arrives.
    """

    kind: Kind
    made: float
    stamp_ns: int
    frame: str
    sensor: str = ""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    covariance: npt.NDArray[np.float64] = field(default_factory=lambda: PRECISE)
    points: Floats = field(default_factory=lambda: np.empty((0, 3), np.float32))
    times: Times = field(default_factory=dict)
    lost: bool = False

    def later(self, seconds: float) -> "Message":
        """The same with a stamp that is so much later."""
        return replace(self, stamp_ns=self.stamp_ns + round(seconds * S))

    def payload(self) -> bytes:
        """As it is sent."""
        if self.kind is Kind.ODOMETRY:
            return encode_odometry(self.stamp_ns, self.frame, self.position, LEVEL, self.covariance)
        return encode_points(self.points, self.stamp_ns, self.frame, self.times)


Effect = Callable[[Message], list[Message]]
"""What a fault makes of a message: none, itself changed, or several."""


def encode_points(points: Floats, stamp_ns: int, frame_id: str, times: Times) -> bytes:
    """Return a cloud with fields of any name and type beside x, y and z."""
    columns = {"x": "<f4", "y": "<f4", "z": "<f4", **{name: values.dtype.str for name, values in times.items()}}
    data = np.empty(len(points), np.dtype(list(columns.items())))
    for name, column in zip("xyz", points.T, strict=True):
        data[name] = column
    for name, values in times.items():
        data[name] = values
    message = PointCloud(frame_id=frame_id, point_stride=data.dtype.itemsize, data=data.tobytes())
    write_stamp(message, stamp_ns)
    for name, dtype in columns.items():
        _, offset = data.dtype.fields[name][:2]  # type: ignore[index]
        message.fields.append(PackedElementField(name=name, offset=offset, type=FIELD_TYPES[dtype[1:]]))
    return message.SerializeToString()


@dataclass(frozen=True)
class Scanner:
    """``latency``: seconds from the end of a sweep until its cloud is sent. A ``timed`` one gives each point's time."""

    frame: str
    hz: float
    latency: float
    timed: bool

    @property
    def sweep(self) -> float:
        """Seconds from the first point of a cloud to the last."""
        return 0.9 / self.hz if self.timed else 0.0


@dataclass(frozen=True)
class Walker:
    """A robot: rates in Hz, latencies in s, speed in m/s. Along x, in its own lane."""

    name: str
    odometry_hz: float
    odometry_latency: float
    scanners: tuple[Scanner, ...]
    speed: float
    lane: float
    seed: int

    @classmethod
    def draw(cls, name: str, lane: float, random: Random, *, timed: bool | None = None) -> "Walker":
        """One of many that work well; ``timed``: whether its scanners must give times, or must not."""
        scanners = tuple(
            Scanner(
                frame, random.uniform(6.0, 12.0), random.uniform(0.01, 0.1),
                random.random() < 0.5 if timed is None else timed,
            )
            for frame in SENSORS
        )  # fmt: skip
        return cls(
            name, random.uniform(20.0, 50.0), random.uniform(0.002, 0.03), scanners, random.uniform(0.3, 1.5), lane,
            random.randrange(1 << 32),
        )  # fmt: skip

    def position(self, made: float) -> tuple[float, float, float]:
        """Where it is at a second of its life."""
        return 20.0 + self.speed * made, self.lane, 0.0

    def messages(self, born_ns: int) -> Iterator[tuple[float, Message]]:
        """Yield (second of its life when it is sent, message), for ever. ``born_ns`` is the wall time of second 0."""
        noise = np.random.default_rng(self.seed)
        streams = [self._odometry(born_ns), *(self._clouds(scanner, born_ns, noise) for scanner in self.scanners)]
        return heapq.merge(*streams, key=lambda sent: sent[0])

    def _odometry(self, born_ns: int) -> Iterator[tuple[float, Message]]:
        number = 0
        while True:
            made = number / self.odometry_hz
            stamp = born_ns + round(made * S)
            message = Message(Kind.ODOMETRY, made, stamp, "map", position=self.position(made))
            yield made + self.odometry_latency, message
            number += 1

    def _clouds(self, scanner: Scanner, born_ns: int, noise: np.random.Generator) -> Iterator[tuple[float, Message]]:
        number = 0
        while True:
            made = 0.2 + number / scanner.hz
            points = ground(noise)
            times: Times = {}
            if scanner.timed:
                times = {"t": np.linspace(0.0, scanner.sweep * S, len(points)).astype(np.uint32)}
            message = Message(
                Kind.POINTS, made, born_ns + round(made * S), scanner.frame, scanner.frame, points=points, times=times
            )
            yield made + scanner.sweep + scanner.latency, message
            number += 1


SIDE = 24
"""Points along the sides of a cloud; more than a scanner measures at one moment."""


def ground(noise: np.random.Generator) -> Floats:
    """(N, 3) points of flat ground in front of a scanner that is 1 m above it, 2.5 to 5.5 m away."""
    x, y = np.meshgrid(np.linspace(2.5, 5.5, SIDE), np.linspace(-2.0, 2.0, SIDE))
    points = np.stack([x, y, np.full_like(x, -1.0)], axis=-1).reshape(-1, 3)
    return (points + noise.normal(0.0, 0.005, points.shape)).astype(np.float32)
