"""The whole configuration: rules across its sections, the map's identity, and its public form without secrets.

Files are read and merged in ``config_load``.
"""

import json
import math
from typing import Annotated, Any, Final

import xxhash
from pydantic import AfterValidator, Field, SecretStr, model_validator

from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.keys import TEMPLATES, Keys
from roughmap_schemas.layers import layers_of
from roughmap_schemas.robot_sections import Policy, RobotConfig, SensorConfig
from roughmap_schemas.ros2_sections import Ros2Config
from roughmap_schemas.sections import (
    HttpConfig,
    InputConfig,
    LogConfig,
    MapConfig,
    QueryConfig,
    Section,
    ServiceConfig,
    StoreConfig,
    UpdatesConfig,
    ZenohConfig,
)
from roughmap_schemas.values import Frame, Name

REMOVED: Final = {
    "input.max_poses": "20000 poses per robot",
    "input.max_transforms": "1000 transforms per robot",
    "input.max_turn": "0.3 rad beyond what 50 rad/s^2 explain",
    "input.pose_queue": "10000 queued poses and transforms",
    "service.control_timeout": "30 s",
}
"""Settings of earlier versions, and the constant that took the place of each."""

HIDDEN: Final = "hidden"
"""Stands in for a secret."""


def _all_keys(value: dict[str, str]) -> dict[str, str]:
    full = {**TEMPLATES, **value}
    try:
        Keys("site", full)
    except ConfigFault as error:
        raise ValueError(str(error)) from None
    for name in value:
        same = [other for other, text in full.items() if text == full[name] and other != name]
        if same:
            raise ValueError(f"keys.{name}: must differ from keys.{same[0]}; both are {full[name]!r}")
    return full


class Config(Section):
    """All settings."""

    map: MapConfig = MapConfig()
    zenoh: ZenohConfig = ZenohConfig()
    input: InputConfig = InputConfig()
    sensors: dict[Frame, SensorConfig] = Field(default={})
    robots: dict[Name, RobotConfig] = Field(default={})
    updates: UpdatesConfig = UpdatesConfig()
    query: QueryConfig = QueryConfig()
    log: LogConfig = LogConfig()
    store: StoreConfig = StoreConfig()
    http: HttpConfig = HttpConfig()
    service: ServiceConfig = ServiceConfig()
    ros2: Ros2Config = Ros2Config()
    keys: Annotated[dict[str, str], AfterValidator(_all_keys)] = Field(default={})
    """Key expressions by name, see ``keys.TEMPLATES``; complete after loading."""

    @classmethod
    def from_log(cls, values: dict[str, Any]) -> "Config":
        """Make the settings from a log file's metadata, without those in ``REMOVED``; raises ``ValueError``."""

        def kept(section: str, table: Any) -> Any:
            if not isinstance(table, dict):
                return table
            return {name: value for name, value in table.items() if f"{section}.{name}" not in REMOVED}

        given: Any = values  # from a file: it may be anything that JSON can hold
        if isinstance(given, dict):
            given = {section: kept(section, table) for section, table in given.items()}
            if isinstance(given.get("map"), dict):  # logs of versions without these settings
                given["map"] = {"max_vertical_sigma": "inf", "surface": "all", **given["map"]}
        return cls.model_validate(given)

    @model_validator(mode="before")
    @classmethod
    def _robots_over_general(cls, values: Any) -> Any:
        """Merge each robot's sensor tables over the general tables of the same frame."""
        general = values.get("sensors") if isinstance(values, dict) else None
        robots = values.get("robots") if isinstance(values, dict) else None
        if not isinstance(general, dict) or not isinstance(robots, dict):
            return values

        def merged(robot: Any) -> Any:
            sensors = robot.get("sensors") if isinstance(robot, dict) else None
            if not isinstance(sensors, dict):
                return robot
            return {**robot, "sensors": {frame: over(general.get(frame), own) for frame, own in sensors.items()}}

        def over(base: Any, own: Any) -> Any:
            return {**base, **own} if isinstance(base, dict) and isinstance(own, dict) else own

        return {**values, "robots": {name: merged(robot) for name, robot in robots.items()}}

    @model_validator(mode="after")
    def _together(self) -> "Config":
        if any(level >= self.map.levels for level in self.updates.levels):
            raise ValueError(
                f"updates.levels: must be below map.levels, 0 to {self.map.levels - 1}; found {self.updates.levels}"
            )
        known = layers_of(self.map.surface)
        if missing := [name for name in self.updates.layers if name not in known]:
            raise ValueError(f'updates.layers: {missing[0]!r} needs map.surface = "ground"')
        if self.log.keep is not None and self.store.path is None:
            raise ValueError(
                'log.keep: must be "" (keep all) unless store.path is set: without a store every file is needed'
            )
        if self.map.frame_id in self.sensors:
            raise ValueError(f"sensors.{self.map.frame_id}: must not be the map's own frame (map.frame_id)")
        for name, robot in self.robots.items():
            if self.map.frame_id in robot.sensors:
                raise ValueError(f"robots.{name}.sensors.{self.map.frame_id}: must not be the map's own frame")
        return self

    def sensor(self, robot: str, frame_id: str) -> SensorConfig | None:
        """Return a sensor's settings on a robot; None if it is not configured."""
        own = self.robots.get(robot)
        if own is not None and frame_id in own.sensors:
            return own.sensors[frame_id]
        return self.sensors.get(frame_id)

    def sensors_of(self, robot: str) -> dict[str, SensorConfig]:
        """Return the settings of all sensors of a robot, by frame."""
        own = self.robots.get(robot)
        return dict(self.sensors) if own is None else {**self.sensors, **own.sensors}

    def pose_covariance(self, robot: str) -> Policy:
        """Return how the covariances of a robot's poses are used."""
        own = self.robots.get(robot)
        return "message" if own is None else own.pose_covariance

    def pose_error_time(self, robot: str) -> float:
        """Return how long errors of a robot's poses last, in seconds."""
        return self.robots.get(robot, RobotConfig()).pose_error_time

    def identity(self) -> dict[str, Any]:
        """Return the settings that determine the map's cells: with other values the cells would differ."""
        # Imported here: it loads the kernels, which most readers of a configuration don't need.
        from roughmap.cell import STATE_VERSION  # noqa: PLC0415

        names = (
            "name", "frame_id", "surface", "cell_size", "error_model", "coverage", "min_radius", "min_distance",
            "min_share", "max_horizontal_radius", "max_vertical_sigma", "bounds",
        )  # fmt: skip
        values = _jsonable(self.map.model_dump(mode="python"))
        return {"state_version": STATE_VERSION, **{name: values[name] for name in names}}

    def public_dict(self) -> dict[str, Any]:
        """Return all settings as JSON values that validate to the same settings, secrets hidden, infinity as "inf"."""
        values: dict[str, Any] = _jsonable(self.model_dump(mode="python"))
        for name in ("listen", "connect"):
            values["zenoh"][name] = [without_secrets(endpoint) for endpoint in values["zenoh"][name]]
        return values


def _jsonable(value: Any) -> Any:
    """Turn tuples into lists and infinities into texts that read back, and hide secrets."""
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, SecretStr):
        return HIDDEN
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def without_secrets(endpoint: str) -> str:
    """Hide all that follows an endpoint's address: it may hold certificates, keys and passwords."""
    cut = min((at for mark in "?#" if (at := endpoint.find(mark)) >= 0), default=-1)
    return endpoint if cut < 0 else f"{endpoint[:cut]}#{HIDDEN}"


def configuration_digest(config: Config) -> str:
    """Return XXH3-128, 32 hex digits, of the identity as JSON: sorted names, no blanks, floats as in Python."""
    text = json.dumps(config.identity(), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return xxhash.xxh3_128_hexdigest(text.encode())
