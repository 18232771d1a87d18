"""The configuration, unpacked once into the plain values that the rules of a run use."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from roughmap import Limits, Noise, RoughMap
from roughmap.tiles.shelf import Shelf
from roughmap_schemas import Config, SensorConfig
from roughmap_service.run.poses import MAX_POSES
from roughmap_service.run.transforms import MAX_TRANSFORMS

NS = 1_000_000_000

RULES = 2
"""Version of the rules that decide on poses and clouds. A log of earlier rules is replayed by its events."""

LARGEST_SIGMA = 1e100
"""Larger sigmas count as this one: its square is still finite."""

LONGEST = float(1 << 32)
"""Seconds that span all stamps; more might not fit an integer number of nanoseconds."""


@dataclass(frozen=True)
class Sensor:
    """A sensor as the core takes it: its pose on the robot, its noise, and the limits on its points.

    ``by_transform``: its pose comes with the robot's transforms, and ``translation`` and ``rotation`` don't count.
    """

    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    noise: Noise
    limits: Limits
    by_transform: bool


class Settings:
    """The settings that poses, decisions and integration depend on.

    ``max_poses`` and ``max_transforms`` differ from the constants only in logs of versions that had settings for them.
    ``rules`` are those of the log.
    """

    def __init__(
        self,
        config: Config,
        *,
        rules: int = RULES,
        max_poses: int = MAX_POSES,
        max_transforms: int = MAX_TRANSFORMS,
    ) -> None:
        inputs = config.input
        self.config = config
        self.rules = rules
        self.max_poses = max_poses
        self.max_transforms = max_transforms
        self.frame_id = config.map.frame_id
        self.max_wait = inputs.max_wait
        self.max_pose_gap = inputs.max_pose_gap
        self.max_pose_gap_ns = Limits(max_pose_gap=inputs.max_pose_gap).max_gap_ns
        self.history_ns = round(min(inputs.pose_history, LONGEST) * NS)
        self.max_speed = inputs.max_speed
        self.max_leap = inputs.max_leap
        self.max_acceleration = inputs.max_acceleration
        self.queue_limit = inputs.queue_limit
        self.max_robots = inputs.max_robots
        self.max_new_tiles = config.map.max_new_tiles
        self.max_tiles = config.map.max_tiles
        self.pose_sigma = pose_sigma = np.minimum(np.array(inputs.pose_sigma, np.float64), LARGEST_SIGMA)
        placed_sigma = min(inputs.placed_sigma, LARGEST_SIGMA)
        self.pose_covariance: npt.NDArray[np.float64] = np.diag(pose_sigma * pose_sigma)
        self.placed_variance = placed_sigma * placed_sigma
        self.placed_covariance: npt.NDArray[np.float64] = np.eye(3) * self.placed_variance
        self.clears = config.map.surface == "ground"
        self.keep_radius = config.map.keep.radius
        self.keep_age_ns = config.map.keep.age * NS
        self.forgets = math.isfinite(self.keep_radius) or math.isfinite(self.keep_age_ns)
        self.clear_interval_ns = round(min(config.map.clear_interval, LONGEST) * NS)
        # A transform that moves by more than three sigmas of a pose is a correction, not drift.
        self.jump_m = 3.0 * max(inputs.pose_sigma[:3])
        self.jump_rad = 3.0 * max(inputs.pose_sigma[3:])
        self._sensors: dict[tuple[str, str], Sensor | None] = {}

    @classmethod
    def of_log(cls, config: Config, stored: Mapping[str, Any], rules: int) -> Self:
        """Return the settings of a log file: its ``config``, its rules, the limits that ``stored`` names."""
        inputs = stored.get("input", {})
        limits = {name: inputs[name] for name in ("max_poses", "max_transforms") if isinstance(inputs.get(name), int)}
        return cls(config, rules=rules, **limits)

    def sensor(self, robot: str, frame_id: str) -> Sensor | None:
        """The sensor with that frame on that robot; None if it is not configured."""
        key = (robot, frame_id)
        if key not in self._sensors:
            found = self.config.sensor(robot, frame_id)
            if found is None:
                return None  # not cached: unknown frame names come from outside, and there is no limit on their number
            self._sensors[key] = _sensor(found, self.max_pose_gap, self.pose_error_time(robot))
        return self._sensors[key]

    def by_transform(self, robot: str, frame_id: str) -> bool:
        """Return whether that sensor's pose on the robot comes with the robot's transforms."""
        sensor = self.sensor(robot, frame_id)
        return sensor is not None and sensor.by_transform

    def pose_error_time(self, robot: str) -> float:
        """How long errors of a robot's poses last, in seconds."""
        return min(self.config.pose_error_time(robot), LONGEST)


def time_offset_ns(config: SensorConfig) -> int:
    """Return what is added to the stamps of a sensor's clouds."""
    return round(min(max(config.time_offset, -LONGEST), LONGEST) * NS)


def _sensor(config: SensorConfig, max_pose_gap: float, pose_error_time: float) -> Sensor:
    return Sensor(
        translation=config.translation,
        rotation=config.rotation,
        noise=Noise(
            range_sigma=config.range_sigma,
            range_sigma_per_m=config.range_sigma_per_m,
            beam_sigma=config.beam_sigma,
            mount_sigma=config.mount_sigma if any(config.mount_sigma) else None,
            pose_error_time=pose_error_time,
        ),
        limits=Limits(
            min_range=config.min_range,
            max_range=config.max_range,
            ceiling=config.ceiling,
            ceiling_slope=config.ceiling_slope,
            max_pose_gap=max_pose_gap,
            exclude=tuple(config.exclude),
            fov=config.fov,
        ),
        by_transform=config.extrinsics == "transform",
    )


CACHE_SHARE = 1 / 16
"""Part of the memory limit for drawn tiles that are kept for readers, and for merged ones."""

_MERGED_LEAST = 16 << 20
"""Bytes for merged tiles and tiles read from the shelf, up to a quarter of the memory limit. With less, a query of a
coarse level reads the same tiles of a map of the ground again and again: each is needed by its neighbours too."""


def new_map(config: Config, shelf: Shelf | None = None) -> RoughMap:
    """Make an empty map with the configuration's identity."""
    m = config.map
    rough_map = RoughMap(
        cell_size=m.cell_size,
        error_model=m.error_model,
        coverage=m.coverage,
        min_radius=m.min_radius,
        min_distance=m.min_distance,
        min_share=m.min_share,
        max_horizontal_radius=m.max_horizontal_radius,
        max_vertical_sigma=m.max_vertical_sigma,
        bounds=m.bounds,
        levels=m.levels,
        surface=m.surface,
        threads=config.service.threads or None,
        shelf=shelf,
    )
    rough_map.limit_cache(max(int(m.memory_limit * CACHE_SHARE), min(_MERGED_LEAST, m.memory_limit // 4)))
    return rough_map
