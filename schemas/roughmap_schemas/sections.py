"""The sections of the configuration, one model each; every setting has its default and its range.

Units are seconds, metres, radians, m/s, rad/s and bytes. Six numbers are x y z roll pitch yaw.
"""

import math
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, SecretStr, model_validator

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
"""Cells across the largest footprint, so that the cells written for one point are bounded."""

MAX_MESSAGE_BYTES: Final = 1 << 29
"""Upper bound of input.max_message: readers of the log refuse records of twice that size."""


class Section(BaseModel):
    """The base of all sections."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, use_attribute_docstrings=True)


def _known_layers(value: list[str]) -> list[str]:
    for name in value:
        if name not in LAYERS:
            raise ValueError(f"must be from {', '.join(LAYERS)}")
    return value


def _known_limits(value: dict[str, float]) -> dict[str, float]:
    for name in value:
        if name not in LIMIT_NAMES:
            raise ValueError(f"{name!r} must be one of {', '.join(LIMIT_NAMES)}")
    return value


class MapConfig(Section):
    """The map: its cells, its error model, and how much it may grow."""

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
    """Resident memory of the process, beyond what it needs without tiles; above it tiles go to the spill file."""
    spill_path: Annotated[str | None, MaybeNone] = None
    """Default: tiles.spill in log.directory."""
    spill_limit: Size = 64 << 30
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
                f"map.max_horizontal_radius: must be at most {MAX_FOOTPRINT_CELLS // 2} map.cell_size, like "
                f"map.min_radius; a footprint would be {across:.0f} cells across"
            )
        return self


def _endpoints(value: object) -> object:
    return [] if value == "" else value


ENDPOINT_PATTERN = r"^[a-z][a-z0-9_-]*/.+"
"""A Zenoh endpoint: protocol/address, optionally with ?metadata and #settings."""

Endpoint = Annotated[str, Field(pattern=ENDPOINT_PATTERN)]
Endpoints = Annotated[list[Endpoint], BeforeValidator(_endpoints, json_schema_input_type=list[Endpoint] | Literal[""])]


class ZenohConfig(Section):
    """The Zenoh session. Settings that are not given keep the value in ``config_file``, a Zenoh JSON5 file."""

    mode: Literal["peer", "client", "router"] = "peer"
    listen: Endpoints = ["tcp/127.0.0.1:7447"]
    connect: Endpoints = []
    scouting: bool = False
    shared_memory: bool = False
    """Use shared memory on this machine. Zenoh keeps 17 MiB for each process that ever sent a message."""
    config_file: Annotated[str | None, MaybeNone] = None
    authority: Annotated[str | None, MaybeNone] = None
    """PEM file of the trusted certificate authority. If set, clients must have a certificate of it."""
    certificate: Annotated[str | None, MaybeNone] = None
    """PEM file of this session's own certificate, for listening and connecting."""
    private_key: Annotated[str | None, MaybeNone] = None
    user: Annotated[str | None, MaybeNone] = None
    password: Annotated[SecretStr | None, MaybeNone] = None
    """Environment only: ``ROUGHMAP_ZENOH__PASSWORD``."""
    password_file: Annotated[str | None, MaybeNone] = None

    @model_validator(mode="after")
    def _pairs(self) -> "ZenohConfig":
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("zenoh.certificate: must be given together with zenoh.private_key")
        if self.password is not None and self.password_file is not None:
            raise ValueError("zenoh.password_file: must not be given beside zenoh.password")
        if (self.user is None) != (self.password is None and self.password_file is None):
            raise ValueError("zenoh.user: must be given together with zenoh.password_file (or zenoh.password)")
        return self


class InputConfig(Section):
    """Inputs: how long clouds wait, which poses place them, how large messages may be."""

    max_wait: NotNegative = 0.5
    max_pose_gap: Positive = 0.5
    pose_history: Positive = 10.0
    max_speed: Positive = 30.0
    max_turn: Positive = 20.0
    pose_sigma: SixSigmas = (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
    placed_sigma: NotNegative = 0.02
    max_points: AtLeastOne = 4_000_000
    max_message: Size = 64 << 20
    """Bytes of a message. A larger one is refused as `too_large`. One of more than twice the size is dropped by Zenoh
    before it is complete, without an error; only a publisher's numbering shows the gap."""
    queue_limit: Size = 64 << 20
    duplicates: NotNegativeWhole = 10_000
    """Messages remembered, so that the same bytes sent again enter the map once. The oldest message of the robot with
    the most is forgotten first. A reset forgets none, so a message sent before it does not enter the empty map if it is
    sent again."""
    robots: Annotated[list[Name], Once] = []
    """Robots that may send. Empty: all."""
    max_robots: AtLeastOne = 256
    """Number of robots if ``robots`` is empty, since each needs a pose buffer. Any further one is refused as
    `unknown_robot`."""

    @model_validator(mode="after")
    def _fits(self) -> "InputConfig":
        if self.max_message > min(self.queue_limit, MAX_MESSAGE_BYTES):
            raise ValueError(
                f"input.max_message: must be at most input.queue_limit ({self.queue_limit}), or a cloud of that size "
                f"would always be refused as busy, and at most {MAX_MESSAGE_BYTES}; found {self.max_message}"
            )
        return self


class SensorConfig(Section):
    """A sensor: its pose on the robot, its errors, and which of its points are kept."""

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
    """Boxes xmin, ymin, zmin, xmax, ymax, zmax in the robot's frame whose points are rejected: the robot itself."""

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


def _as_it_is(value: object) -> object:
    return value


class RobotConfig(Section):
    """One robot: settings of its sensors, merged over the general ones of the same frame."""

    sensors: Annotated[
        dict[Frame, SensorConfig], BeforeValidator(_as_it_is, json_schema_input_type=dict[Frame, SensorOverrides])
    ] = {}


class UpdatesConfig(Section):
    """The published updates of tiles."""

    layers: Annotated[list[str], Field(min_length=1), Once, AfterValidator(_known_layers)] = [
        "mean_height",
        "range",
        "confidence_factor",
    ]
    levels: Annotated[list[NotNegativeWhole], Once] = [0]
    update_hz: Positive = 2.0


class QueryConfig(Section):
    """Limits on queries."""

    workers: Annotated[int, Field(ge=1, le=256), NUMBER] = 4
    max_reply_tiles: AtLeastOne = 1024
    max_region_cells: AtLeastOne = 4_000_000
    max_running_cells: AtLeastOne = 16_000_000
    """Cells of all queries that are answered at the same time, 64 bytes each. Cells of a region with more than five
    layers (f4) count several times."""
    queue_limit: AtLeastOne = 64
    cache_limit: Size = 64 << 20
    """Bytes of encoded tiles kept for repeated queries."""


class LogConfig(Section):
    """The log's files."""

    directory: Annotated[str, Field(min_length=1)] = "log"
    compression: Literal["none", "lz4", "zstd"] = "none"
    flush_interval: Positive = 0.2
    checkpoint_interval: Positive = 1.0
    max_file_bytes: Size = 1 << 30
    """Size at which a file ends. It is checked between batches, so a file may be larger by a few hundred messages, or
    with ``updates = "grids"`` by all tiles that changed in one round."""
    max_file_age: Positive = 3600.0
    keep: Annotated[Size | None, MaybeNone] = None
    """Bytes of all log files in the directory: of all runs, with the current file and what a repair set aside
    (``.torn``, ``.behind``). After each snapshot the oldest files that it does not need are deleted, so between
    snapshots there may be more. Default: keep all."""
    updates: Literal["records", "grids", "none"] = "records"
    queries: bool = True
    queue_limit: Size = 128 << 20


class StoreConfig(Section):
    """The stored map."""

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
    """The HTTP server for health and metrics."""

    listen: Annotated[str | None, MaybeNone, AfterValidator(_address)] = "127.0.0.1:8080"
    token: Annotated[SecretStr | None, MaybeNone] = None
    """Bearer token, needed for anything but health. Environment only: ``ROUGHMAP_HTTP__TOKEN``."""
    token_file: Annotated[str | None, MaybeNone] = None
    """File with the token."""

    @model_validator(mode="after")
    def _one_token(self) -> "HttpConfig":
        if self.token is not None and self.token_file is not None:
            raise ValueError("http.token_file: must not be given beside http.token")
        return self


class ServiceConfig(Section):
    """The process itself."""

    shutdown_timeout: Positive = 8.0
    threads: Annotated[int, Field(ge=0, le=1024), NUMBER] = 0
    """Threads that integrate. 0: numba's default."""
    alive_wait: NotNegative = 15.0
    """How long to wait for another instance to go. The token of a killed one stays until its Zenoh lease ends."""
    log_format: Literal["auto", "json", "text"] = "auto"
    """Format of the lines on stderr. "auto" is text on a terminal and JSON elsewhere."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
