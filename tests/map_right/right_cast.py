"""Simple worlds and a spinning scanner that sees them.

A world is a few solid shapes in axes of its own: the robot drives along x, and what it meets lies across. The map's
axes are turned and shifted against these, so that nothing lies along the cells.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from right_maps import Sweep
from scipy.spatial.transform import Rotation

from roughmap import Limits, Noise, Scan, Trajectory

FAR = 40.0
"""Metres: the scanner's reach; a shape that goes on reaches that far."""


@dataclass(frozen=True)
class Slab:
    """What lies below the plane z = ``height`` + ``slope`` . (x, y)."""

    height: float = 0.0
    slope: tuple[float, float] = (0.0, 0.0)

    def meet(self, origin: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """Ranges (N,) at which unit ``beams`` (N, 3) from ``origin`` meet it; else inf."""
        a, b = self.slope
        above = origin[2] - self.height - a * origin[0] - b * origin[1]
        falls = a * beams[:, 0] + b * beams[:, 1] - beams[:, 2]
        with np.errstate(divide="ignore"):
            return np.where(falls > 1e-12, above / falls, np.inf)


@dataclass(frozen=True)
class Block:
    """A box between two corners."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def meet(self, origin: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """As `Slab.meet`, from outside."""
        enter, leave = np.full(len(beams), 0.0), np.full(len(beams), np.inf)
        for axis in range(3):
            along = np.where(np.abs(beams[:, axis]) < 1e-12, 1e-12, beams[:, axis])
            one, two = (self.low[axis] - origin[axis]) / along, (self.high[axis] - origin[axis]) / along
            enter, leave = np.maximum(enter, np.minimum(one, two)), np.minimum(leave, np.maximum(one, two))
        return np.where((enter < leave) & (enter > 0.0), enter, np.inf)


@dataclass(frozen=True)
class Post:
    """An upright cylinder's wall."""

    x: float
    y: float
    radius: float
    low: float
    high: float

    def meet(self, origin: np.ndarray, beams: np.ndarray) -> np.ndarray:
        """As `Slab.meet`, from outside."""
        to = origin[:2] - (self.x, self.y)
        a = (beams[:, :2] ** 2).sum(axis=1)
        b = beams[:, :2] @ to
        inside = b * b - a * (to @ to - self.radius**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (-b - np.sqrt(inside)) / a
            z = origin[2] + t * beams[:, 2]
        return np.where((inside > 0.0) & (t > 0.0) & (z > self.low) & (z < self.high), t, np.inf)


Shape = Slab | Block | Post


@dataclass(frozen=True)
class Scanner:
    """64 rings of 1024 beams from -45 to 45 degrees as in the recordings, turned through ``sector`` degrees to either
    side of straight ahead; the beams beyond would see nothing that is judged.

    Ranges have a standard error of 1 cm, 2 % of the beams return nothing. The robot pitches and rolls by a degree as
    it goes, which it knows but for 1 mrad; its position it knows but for 5 mm.
    """

    rings: int = 64
    columns: int = 1024
    rise: float = 45.0
    sector: float = 40.0
    range_sigma: float = 0.01
    lost: float = 0.02
    rock: float = 1.0
    pose_sigma: float = 0.005
    angle_sigma: float = 0.001
    beams: np.ndarray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        up = np.radians(np.linspace(-self.rise, self.rise, self.rings))[:, None]
        around = np.arange(self.columns) * 2.0 * math.pi / self.columns - math.pi
        around = around[np.abs(around) <= math.radians(self.sector)][None]
        beams = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0.0 * around], -1)
        object.__setattr__(self, "beams", beams.reshape(-1, 3))

    @property
    def noise(self) -> Noise:
        """As the map is told."""
        return Noise(range_sigma=self.range_sigma, beam_sigma=0.001)


@dataclass(frozen=True)
class Axes:
    """The world's axes in the map: turned by ``yaw``, its origin at ``shift``."""

    yaw: float
    shift: tuple[float, float, float]

    @property
    def rotation(self) -> Rotation:
        """From the world's axes to the map's."""
        return Rotation.from_euler("z", self.yaw)

    def local(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places of the map in the world's axes."""
        dx, dy = x - self.shift[0], y - self.shift[1]
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return c * dx + s * dy, c * dy - s * dx


def drive(
    worlds: Sequence[Sequence[Shape]],
    at: np.ndarray,
    level: Rotation,
    scanner: Scanner,
    axes: Axes,
    rng: np.random.Generator,
    rate: float = 10.0,
    limits: Limits | None = None,
) -> list[Sweep]:
    """The sweeps of a robot at ``at`` (M, 3; the scanner's places in the world's axes), one of ``worlds`` at each.

    ``level``: how the robot stands on its ground, in the world's axes. ``rate``: sweeps a second; every second one
    clears at 10 Hz, all at 5 Hz or fewer. The robot's and the scanner's axes are the same.
    """
    stamps = 1_700_000_000_000_000_000 + np.rint(np.arange(len(at)) / rate * 1e9).astype(np.int64)
    rock = Rotation.from_rotvec(np.radians(rng.normal(0.0, scanner.rock, (len(at), 3)) * (1.0, 1.0, 0.3)))
    turned = level * rock
    known_at = axes.rotation.apply(at) + axes.shift + rng.normal(0.0, scanner.pose_sigma, at.shape)
    wrong = Rotation.from_rotvec(rng.normal(0.0, scanner.angle_sigma, at.shape))
    known = wrong * axes.rotation * turned
    S = np.diag([scanner.pose_sigma**2] * 3 + [scanner.angle_sigma**2] * 3)
    way = Trajectory(stamps, known_at, known.as_quat(), np.broadcast_to(S, (len(at), 6, 6)))
    every = max(1, round(rate / 5.0))
    sweeps = []
    for k, world in enumerate(worlds):
        points = cast(world, at[k], turned[k], scanner, rng)
        scan = Scan(points, int(stamps[k]))
        sweeps.append(Sweep(scan, way, scanner.noise, limits or Limits(), clear=k % every == 0))
    return sweeps


def cast(
    world: Sequence[Shape], origin: np.ndarray, turned: Rotation, scanner: Scanner, rng: np.random.Generator
) -> np.ndarray:
    """One sweep in the scanner's axes, (N, 3): 0, 0, 0 where nothing returns."""
    beams = turned.apply(scanner.beams)
    ranges = np.min([shape.meet(origin, beams) for shape in world], axis=0)
    ranges[rng.random(len(ranges)) < scanner.lost] = np.inf
    returned = ranges < FAR
    points = np.zeros_like(scanner.beams)
    noisy = ranges[returned] + rng.normal(0.0, scanner.range_sigma, returned.sum())
    points[returned] = scanner.beams[returned] * noisy[:, None]
    return points
