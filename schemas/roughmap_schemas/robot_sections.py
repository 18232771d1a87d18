"""The sections on robots and their sensors."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from roughmap_schemas.sections import Section
from roughmap_schemas.values import (
    Box,
    Ceiling,
    Frame,
    MaybeView,
    NotNegative,
    Positive,
    Reach,
    Real,
    Rotation,
    SixSigmas,
    Three,
)


class SensorConfig(Section):
    """A sensor: its pose on the robot, its errors, and which of its points are kept."""

    translation: Three = (0.0, 0.0, 0.0)
    """Position of the sensor in the robot's base frame."""
    rotation: Rotation = (0.0, 0.0, 0.0, 1.0)
    """Rotation of the sensor in the robot's base frame: quaternion x y z w."""
    extrinsics: Literal["configured", "transform"] = "configured"
    """Where the sensor's pose on the robot comes from: `translation` and `rotation`, or the robot's transform message
    whose child is this sensor's frame (from ROS 2: tf)."""
    range_sigma: NotNegative
    """Standard deviation of a range."""
    range_sigma_per_m: NotNegative = 0.0
    """Added to `range_sigma` for each metre of range."""
    beam_sigma: NotNegative = 0.0
    """Standard deviation of a beam's direction."""
    mount_sigma: SixSigmas = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Standard deviations of the mounting, in the robot's axes."""
    min_range: NotNegative = 0.0
    """Nearer points are rejected."""
    max_range: Reach = math.inf
    """Farther points are rejected."""
    ceiling: Ceiling = math.inf
    """Points higher above the sensor than `ceiling` + `ceiling_slope` times their horizontal distance are rejected."""
    ceiling_slope: Real = 0.0
    """See `ceiling`; metres per metre."""
    time_field: Annotated[str, Field(max_length=64)] = "auto"
    """Field with the points' own times: a name, "none", or "auto": found in the sensor's first clouds."""
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"
    """Unit of the points' times."""
    time_origin: Literal["auto", "start", "end", "absolute"] = "auto"
    """From when the points' times count: the cloud's stamp at the sweep's start or at its end, or the Unix epoch."""
    time_offset: Real = 0.0
    """Added to the stamps of the sensor's clouds, to correct its clock."""
    exclude: list[Box] = Field(default=[])
    """Boxes xmin, ymin, zmin, xmax, ymax, zmax in the robot's frame whose points are rejected: the robot itself."""
    fov: MaybeView = None
    """Field of view from the sensor's x axis, in degrees: up, down, left, right. In it, a direction without a return
    counts as free if the scan has returns at about that elevation, or none higher. Default: unknown."""

    @model_validator(mode="after")
    def _ranges(self) -> "SensorConfig":
        if not self.min_range < self.max_range:
            raise ValueError(f"min_range must be below max_range; found {self.min_range} and {self.max_range}")
        return self


def _all_optional(schema: dict[str, Any]) -> None:
    schema.pop("required", None)
    for member in schema["properties"].values():
        member.pop("default", None)


class SensorOverrides(SensorConfig):
    """A robot's own settings of a sensor; others come from the general table of that frame."""

    # Only for the JSON Schema: when a robot is validated, its tables are already merged over the general ones.
    model_config = ConfigDict(json_schema_extra=_all_optional)


def mounted_twice(values: Mapping[str, Any]) -> str | None:
    """Return what is wrong with a configuration of valid values whose sensor has two sources of its mounting.

    Of a robot's own table counts what it says itself, beside the general ``extrinsics`` of that frame.
    """
    general: Mapping[str, Mapping[str, Any]] = values.get("sensors", {})
    tables = [(f"sensors.{frame}", own, own.get("extrinsics")) for frame, own in general.items()]
    for name, robot in values.get("robots", {}).items():
        for frame, own in robot.get("sensors", {}).items():
            source = own.get("extrinsics", general.get(frame, {}).get("extrinsics"))
            tables.append((f"robots.{name}.sensors.{frame}", own, source))
    for dotted, own, source in tables:
        given = [name for name in ("translation", "rotation") if name in own]
        if given and source == "transform":
            where = "" if "extrinsics" in own else " in the general table of that frame"
            return f'{dotted}: {" and ".join(given)} can\'t be set beside extrinsics = "transform"{where}; keep one'
    return None


def _as_it_is(value: object) -> object:
    return value


Policy = Literal["message", "floor", "cap", "configured"]
"""How the covariances of a robot's poses are used."""


class RobotConfig(Section):
    """One robot: how far its poses are trusted, and its sensors, merged over the general ones of the frame."""

    pose_covariance: Policy = "message"
    """Covariance of the robot's poses: as in the message, at least or at most `input.pose_sigma`, or always that."""
    pose_error_time: Positive = 5.0
    """How long an error of the robot's poses lasts: poses a few times as far apart err independently."""
    sensors: Annotated[
        dict[Frame, SensorConfig], BeforeValidator(_as_it_is, json_schema_input_type=dict[Frame, SensorOverrides])
    ] = Field(default={})
