"""A rover in the simulated world: the messages of its scanner and its localisation, with the true poses known.

The same seed, start and settings give the same messages. The rover drives a figure of eight, in 36 seconds at its
default speed. Roll, pitch and height follow the ground under its wheels. The scanner turns while the rover moves, so
every column of a sweep is measured from another pose. The localisation's error wanders with the stated covariance.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from roughmap_schemas.cloud import encode_cloud
from roughmap_schemas.geometry import Quaternion, multiply, quaternion_of
from roughmap_schemas.odometry import encode_odometry
from roughmap_service.simulation.ground import PATH_HALF_LENGTH, PATH_HALF_WIDTH, path
from roughmap_service.simulation.scanner import NANOSECONDS, Scanner
from roughmap_service.simulation.world import World, inhabited

Floats = npt.NDArray[np.float64]

Kind = Literal["points", "odometry", "transform"]

SENSOR_FRAME = "lidar"
BODY_FRAME = "base"
MAP_FRAME = "map"

MOUNT = (0.25, 0.0, 1.05)
"""The scanner in the robot's frame, metres. Its axes are the robot's."""

FOOTPRINT_X, FOOTPRINT_Y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.35, 0.35, 7))
"""The body is a plane fitted to the ground at these points; metres in the robot's axes."""

ODOMETRY_HZ = 50

WANDER_SECONDS = 2.0
"""Correlation time of the localisation's error."""

POSE_SIGMA = (0.02, 0.02, 0.01, 0.002, 0.002, 0.002)
"""Standard deviation of the localisation's error: metres, and radians about the map's axes."""


class Message(NamedTuple):
    """One message to publish: `payload` of `kind` for `robot`, available from `due_ns` on (a sweep: from its end)."""

    stamp_ns: int
    kind: Kind
    payload: bytes
    robot: str
    due_ns: int


class Pose(NamedTuple):
    """True poses of the robot's base in the map: `position` (N, 3) metres, `rotation` (N, 3, 3)."""

    position: Floats
    rotation: Floats


@dataclass
class Rover:
    """One robot. It starts at `phase` (0 to 1) of the figure of eight; robots of one run share the world."""

    world: World
    name: str = "rover1"
    seed: int = 1
    phase: float = 0.0
    speed: float = 2.1
    scanner: Scanner = field(default_factory=Scanner)
    start_ns: int = 1_700_000_000 * NANOSECONDS

    def pose(self, stamp_ns: npt.ArrayLike) -> Pose:
        """Return the true poses at the stamps (N,)."""
        seconds = (np.asarray(stamp_ns, dtype=np.int64) - self.start_ns) / NANOSECONDS
        # 1.38 makes `speed` the mean over the figure of eight; the rover is slower in the bends.
        angle = 2 * np.pi * self.phase + seconds * self.speed / np.hypot(PATH_HALF_LENGTH, 2 * PATH_HALF_WIDTH) * 1.38
        x, y = path(angle)
        heading = np.arctan2(2 * PATH_HALF_WIDTH * np.cos(2 * angle), PATH_HALF_LENGTH * np.cos(angle))
        c, s = np.cos(heading)[:, None, None], np.sin(heading)[:, None, None]
        height = self.world.ground.height(
            x[:, None, None] + c * FOOTPRINT_X - s * FOOTPRINT_Y, y[:, None, None] + s * FOOTPRINT_X + c * FOOTPRINT_Y
        )
        # Least squares over a symmetric grid: the three unknowns are independent weighted means.
        along = (height * FOOTPRINT_X).sum((1, 2)) / (FOOTPRINT_X**2).sum()
        aside = (height * FOOTPRINT_Y).sum((1, 2)) / (FOOTPRINT_Y**2).sum()
        c, s = c[:, 0, 0], s[:, 0, 0]
        forward = _unit(np.stack([c, s, along], -1))
        up = _unit(np.cross(np.stack([c, s, along], -1), np.stack([-s, c, aside], -1)))
        rotation = np.stack([forward, np.cross(up, forward), up], -1)
        return Pose(np.stack([x, y, height.mean((1, 2))], -1), rotation)

    def messages(self, duration: float) -> Iterator[Message]:
        """Yield all messages of `duration` seconds, in the order of `due_ns`."""
        scan_rng = np.random.default_rng([self.seed, 0x5CA7])
        odometry = self._odometry(duration)
        pending = next(odometry, None)
        for k in range(int(duration * self.scanner.rate_hz)):
            cloud = self._scan(self.start_ns + k * self.scanner.sweep_ns, scan_rng)
            while pending is not None and pending.due_ns <= cloud.due_ns:
                yield pending
                pending = next(odometry, None)
            yield cloud
        while pending is not None:
            yield pending
            pending = next(odometry, None)

    def _scan(self, stamp_ns: int, rng: np.random.Generator) -> Message:
        base = self.pose(stamp_ns + self.scanner.column_offsets_ns())
        # einsum is allowed here: no promise depends on the bits of a simulation.
        position = base.position + np.einsum("nij,j->ni", base.rotation, np.asarray(MOUNT))
        middle = (stamp_ns + self.scanner.sweep_ns // 2 - self.start_ns) / NANOSECONDS
        points, offsets = self.scanner.sweep(self.world, middle, position, base.rotation, rng)
        payload = encode_cloud(points, stamp_ns, SENSOR_FRAME, offsets_ns=offsets)
        return Message(stamp_ns, "points", payload, self.name, stamp_ns + self.scanner.sweep_ns)

    def _odometry(self, duration: float) -> Iterator[Message]:
        """Yield poses at `ODOMETRY_HZ`, from the first sweep's start to one pose after the last sweep's end."""
        rng = np.random.default_rng([self.seed, 0x0D0])
        sigma = np.asarray(POSE_SIGMA)
        covariance = np.diag(sigma**2)
        keep = np.exp(-1 / (ODOMETRY_HZ * WANDER_SECONDS))
        error = rng.normal(0, sigma)  # Gauss-Markov, begun in its stationary state: sigma is right at every stamp
        step = NANOSECONDS // ODOMETRY_HZ
        for k in range(int(duration * ODOMETRY_HZ) + 2):
            stamp = self.start_ns + k * step
            true = self.pose(np.array([stamp]))
            # True pose = (Exp(dtheta) R, t + dt) about the map's axes: the stated pose is the true one minus the error.
            stated = multiply(exponential(-error[3:]), quaternion_of(true.rotation[0].tolist()))
            payload = encode_odometry(stamp, MAP_FRAME, true.position[0] - error[:3], stated, covariance, BODY_FRAME)
            yield Message(stamp, "odometry", payload, self.name, stamp)
            error = keep * error + np.sqrt(1 - keep**2) * rng.normal(0, sigma)


def rovers(count: int, seed: int, start_ns: int, scanner: Scanner | None = None) -> list[Rover]:
    """Return `count` robots (rover1, rover2, ...), spread over the same path in the world of `seed`."""
    world = inhabited(seed)
    return [
        Rover(
            world,
            name=f"rover{k + 1}",
            seed=seed * 1000 + k,
            phase=k / count,
            scanner=Scanner() if scanner is None else scanner,
            start_ns=start_ns,
        )
        for k in range(count)
    ]


def sensor_settings(scanner: Scanner) -> dict[str, object]:
    """Return the `[sensors.lidar]` table that a service needs for these rovers."""
    return {
        "translation": list(MOUNT),
        "rotation": [0.0, 0.0, 0.0, 1.0],
        "range_sigma": scanner.range_sigma,
        "beam_sigma": scanner.beam_sigma,
        "min_range": 0.5,
        "max_range": scanner.max_range + 1.0,
    }


def exponential(vector: Floats) -> Quaternion:
    """Return Exp(vector) as a quaternion: the rotation about the vector by its length in radians."""
    angle = float(np.linalg.norm(vector))
    scale = math.sin(0.5 * angle) / angle if angle > 0 else 0.5
    x, y, z = (scale * float(part) for part in vector)
    return x, y, z, math.cos(0.5 * angle)


def _unit(vectors: Floats) -> Floats:
    lengths: Floats = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / lengths
