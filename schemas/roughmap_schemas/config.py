"""The configuration: one model a section, each setting with its default and its range.

Seconds, metres, radians, m/s, rad/s, bytes; six numbers are x y z roll pitch yaw. The models know no files: reading
and merging stand in ``config_load``.
"""

import json
import math
from typing import Annotated, Any, Final, Literal

import xxhash
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.keys import TEMPLATES, Keys
from roughmap_schemas.layers import LAYERS, LIMIT_NAMES
from roughmap_schemas.values import (
    NUMBER,
    AtLeastOne,
    Box,
    Ceiling,
    Frame,
    MaybeBounds,
    MaybeNone,
    Measure,
    Name,
    NotNegative,
    NotNegativeWhole,
    Once,
    Positive,
    Reach,
    Real,
    Rotation,
    Share,
    SixSigmas,
    Size,
    Three,
)

MAX_FOOTPRINT_CELLS: Final = 512
"""Cells across the largest footprint that the core takes, so that one point never writes without bound."""


class Section(BaseModel):
    """The base of all sections."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


def _known_layers(value: list[str]) -> list[str]:
    for name in value:
        if name not in LAYERS:
            raise ValueError(f"must be of {', '.join(LAYERS)}")
    return value


def _known_limits(value: dict[str, float]) -> dict[str, float]:
    for name in value:
        if name not in LIMIT_NAMES:
            raise ValueError(f"{name!r} must be one of {', '.join(LIMIT_NAMES)}")
    return value


class MapConfig(Section):
    """The map: what a cell is, how errors spread, how much it may grow."""

    name: Name = "site"
    frame_id: Frame = "map"
    cell_size: Measure = 0.1
    error_model: Literal["point", "cuboid", "ellipsoid"] = "cuboid"
    coverage: Measure = 2.0
    min_radius: Measure = 1e-3
    min_distance: Measure = 1e-3
    min_share: Share = 0.05
    max_horizontal_radius: Measure = 0.5
    height_tolerance: Positive = 0.05
    bounds: MaybeBounds = None
    levels: Annotated[int, Field(ge=1, le=24), NUMBER] = 8
    memory_limit: Size = 2 << 30
    max_new_tiles: AtLeastOne = 4096
    max_tiles: AtLeastOne = 4_000_000
    limits: Annotated[dict[str, Positive], AfterValidator(_known_limits)] = {
        "slope": 0.5,
        "step": 0.2,
        "std_dev": 0.1,
        "confidence": 0.9,
    }

    @model_validator(mode="after")
    def _footprint(self) -> "MapConfig":
        across = 2.0 * max(self.max_horizontal_radius, self.min_radius) / self.cell_size
        if not across <= MAX_FOOTPRINT_CELLS:
            raise ValueError(
                f"map.max_horizontal_radius: must be at most {MAX_FOOTPRINT_CELLS // 2} map.cell_size, and so must "
                f"map.min_radius; a footprint would be {across:.0f} cells across"
            )
        return self


def _endpoints(value: object) -> object:
    return [] if value == "" else value


Endpoint = Annotated[str, Field(min_length=1)]
Endpoints = Annotated[list[Endpoint], BeforeValidator(_endpoints, json_schema_input_type=list[Endpoint] | Literal[""])]


class ZenohConfig(Section):
    """The session; what is given nowhere leaves the value of ``config_file`` (a Zenoh JSON5 file) alone."""

    mode: Literal["peer", "client", "router"] = "peer"
    listen: Endpoints = ["tcp/127.0.0.1:7447"]
    connect: Endpoints = []
    scouting: bool = False
    config_file: Annotated[str | None, MaybeNone] = None


class InputConfig(Section):
    """What comes in: how long clouds wait, which poses place them, how large messages may be."""

    max_wait: NotNegative = 0.5
    max_pose_gap: Positive = 0.5
    pose_history: Positive = 10.0
    max_speed: Positive = 30.0
    max_turn: Positive = 20.0
    pose_sigma: SixSigmas = (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
    placed_sigma: NotNegative = 0.02
    max_points: AtLeastOne = 4_000_000
    max_message: Size = 64 << 20
    queue_limit: Size = 64 << 20
    duplicates: NotNegativeWhole = 10_000
    robots: Annotated[list[Name], Once] = []
    """Who may send; empty: any."""


class SensorConfig(Section):
    """A sensor: where it sits on the robot, how far it is to be believed, which of its points are kept."""

    translation: Three = (0.0, 0.0, 0.0)
    rotation: Rotation = (0.0, 0.0, 0.0, 1.0)
    range_sigma: NotNegative
    range_sigma_per_m: NotNegative = 0.0
    beam_sigma: NotNegative = 0.0
    mount_sigma: SixSigmas = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    min_range: NotNegative = 0.0
    max_range: Reach = math.inf
    ceiling: Ceiling = math.inf
    ceiling_slope: Real = 0.0
    exclude: list[Box] = []
    """Boxes xmin, ymin, zmin, xmax, ymax, zmax in the robot's frame: the robot itself."""

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
    """A robot's own settings of a sensor; what is left out comes from the general ones of that frame."""

    # Stands for a JSON Schema alone: when a robot is validated, its tables lie over the general ones already.
    model_config = ConfigDict(json_schema_extra=_all_optional)


def _as_it_is(value: object) -> object:
    return value


class RobotConfig(Section):
    """What differs on one robot: its sensors' settings, over the general ones of the same frame."""

    sensors: Annotated[
        dict[Frame, SensorConfig], BeforeValidator(_as_it_is, json_schema_input_type=dict[Frame, SensorOverrides])
    ] = {}


class UpdatesConfig(Section):
    """What is published of tiles that change."""

    layers: Annotated[list[str], Field(min_length=1), Once, AfterValidator(_known_layers)] = [
        "mean_height",
        "range",
        "confidence_factor",
    ]
    levels: Annotated[list[NotNegativeWhole], Once] = [0]
    update_hz: Positive = 2.0


class QueryConfig(Section):
    """How much may be asked at once."""

    workers: Annotated[int, Field(ge=1, le=256), NUMBER] = 4
    max_reply_tiles: AtLeastOne = 1024
    max_region_cells: AtLeastOne = 4_000_000
    max_running_cells: AtLeastOne = 16_000_000
    queue_limit: AtLeastOne = 64


class LogConfig(Section):
    """The log's files."""

    directory: Annotated[str, Field(min_length=1)] = "log"
    compression: Literal["none", "lz4", "zstd"] = "none"
    flush_interval: Positive = 0.2
    checkpoint_interval: Positive = 1.0
    max_file_bytes: Size = 1 << 30
    max_file_age: Positive = 3600.0
    keep: Annotated[Size | None, MaybeNone] = None
    """Bytes of closed files to keep; none keeps all."""
    updates: Literal["records", "grids", "none"] = "records"
    queries: bool = True
    queue_limit: Size = 128 << 20


class StoreConfig(Section):
    """The map between starts."""

    path: Annotated[str | None, MaybeNone] = None
    snapshot_interval: Positive = 10.0


def _address(value: str | None) -> str | None:
    if value is None:
        return None
    host, colon, port = value.rpartition(":")
    if not (colon and host and port.isascii() and port.isdigit() and int(port) < 65536):
        raise ValueError('must be host:port with a port of 0 to 65535, or "" for none')
    return value


class HttpConfig(Section):
    """Where health, metrics and the viewer are served."""

    listen: Annotated[str | None, MaybeNone, AfterValidator(_address)] = "127.0.0.1:8080"


class ServiceConfig(Section):
    """The process itself."""

    shutdown_timeout: Positive = 8.0
    threads: Annotated[int, Field(ge=0, le=1024), NUMBER] = 0
    """Threads that integrate; 0: as many as numba takes."""
    alive_wait: NotNegative = 15.0
    """How long another instance's token is waited for; a dead one's lives until its lease ends."""


def _all_keys(value: dict[str, str]) -> dict[str, str]:
    full = {**TEMPLATES, **value}
    try:
        Keys("site", full)
    except ConfigFault as error:
        raise ValueError(str(error)) from None
    for name in value:
        same = [other for other, text in full.items() if text == full[name] and other != name]
        if same:
            raise ValueError(f"keys.{name}: must differ from keys.{same[0]}; found {full[name]!r} in both")
    return full


class Config(Section):
    """All settings."""

    map: MapConfig = MapConfig()
    zenoh: ZenohConfig = ZenohConfig()
    input: InputConfig = InputConfig()
    sensors: dict[Frame, SensorConfig] = {}
    robots: dict[Name, RobotConfig] = {}
    updates: UpdatesConfig = UpdatesConfig()
    query: QueryConfig = QueryConfig()
    log: LogConfig = LogConfig()
    store: StoreConfig = StoreConfig()
    http: HttpConfig = HttpConfig()
    service: ServiceConfig = ServiceConfig()
    keys: Annotated[dict[str, str], AfterValidator(_all_keys)] = {}
    """Key expressions by name, see ``keys.TEMPLATES``; complete after loading."""

    @model_validator(mode="before")
    @classmethod
    def _robots_over_general(cls, values: Any) -> Any:
        """Lay each robot's sensor tables over the general tables of the same frame."""
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
        if self.log.keep is not None and self.store.path is None:
            raise ValueError('log.keep: must be "" (all) unless store.path is set: files can\'t be spared otherwise')
        if self.map.frame_id in self.sensors:
            raise ValueError(f"sensors.{self.map.frame_id}: must not be the map's own frame (map.frame_id)")
        for name, robot in self.robots.items():
            if self.map.frame_id in robot.sensors:
                raise ValueError(f"robots.{name}.sensors.{self.map.frame_id}: must not be the map's own frame")
        return self

    def sensor(self, robot: str, frame_id: str) -> SensorConfig | None:
        """Give a sensor's settings on a robot; None if it is not configured."""
        own = self.robots.get(robot)
        if own is not None and frame_id in own.sensors:
            return own.sensors[frame_id]
        return self.sensors.get(frame_id)

    def identity(self) -> dict[str, Any]:
        """Give what makes a map the map that it is: with other values its cells would be others."""
        # Loaded here, since the kernels come with it and most readers of a configuration never ask.
        from roughmap.cell import STATE_VERSION  # noqa: PLC0415

        names = ("name", "frame_id", "cell_size", "error_model", "coverage", "min_radius", "min_distance", "min_share")
        values = self.map.model_dump(mode="json")
        return {
            "state_version": STATE_VERSION,
            **{name: values[name] for name in (*names, "max_horizontal_radius", "bounds")},
        }

    def public_dict(self) -> dict[str, Any]:
        """Give all settings as JSON values, secrets hidden; infinity as "inf". It validates to the same settings."""
        values: dict[str, Any] = _jsonable(self.model_dump(mode="python"))
        for name in ("listen", "connect"):
            values["zenoh"][name] = [_without_secrets(endpoint) for endpoint in values["zenoh"][name]]
        return values


def _jsonable(value: Any) -> Any:
    """Turn tuples into lists and infinities, which JSON lacks, into texts that read back."""
    if isinstance(value, dict):
        return {key: _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _without_secrets(endpoint: str) -> str:
    """Cut what follows an endpoint's address: there certificates, keys and passwords may stand."""
    cut = min((at for mark in "?#" if (at := endpoint.find(mark)) >= 0), default=-1)
    return endpoint if cut < 0 else f"{endpoint[:cut]}#hidden"


def configuration_digest(config: Config) -> str:
    """Give XXH3-128, 32 hex digits, of the identity as JSON: names sorted, no blanks, floats as Python writes them."""
    text = json.dumps(config.identity(), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return xxhash.xxh3_128_hexdigest(text.encode())
