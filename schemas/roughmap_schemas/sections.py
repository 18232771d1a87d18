"""The sections of the configuration, one model each; every setting has its default and its range.

Units are seconds, metres, radians, m/s, rad/s and bytes. Six numbers are x y z roll pitch yaw.
"""

import math
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, SecretStr, model_validator

from roughmap_schemas.layers import DEFAULT_SURFACE, LAYERS, Surface, default_limits, fault_of_limit
from roughmap_schemas.values import (
    NUMBER,
    AtLeastOne,
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
    Share,
    SixSigmas,
    Size,
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


class KeepConfig(Section):
    """What the map keeps. The rest is forgotten, by whole tiles; by default nothing is."""

    radius: Reach = math.inf
    """Tiles that lie farther from the newest pose of every robot are forgotten."""
    age: Reach = math.inf
    """Tiles without a point for so long are forgotten, by the stamps of the points."""


class MapConfig(Section):
    """The map: its cells, its error model, and how much it may grow."""

    name: Name = "site"
    """Name of the map, part of all its Zenoh keys."""
    frame_id: Frame = "map"
    """Frame of the map, into which all points are placed."""
    surface: Surface = DEFAULT_SURFACE
    """What a cell describes: the ground, with what stands on it or hangs over it kept apart ("ground"), or all of its
    points together ("all")."""
    cell_size: Measure = 0.1
    """Side of a cell, metres."""
    error_model: Literal["point", "cuboid", "ellipsoid"] = "cuboid"
    """How a point is spread over cells: not at all ("point"), or by a box or an ellipsoid around it."""
    coverage: Measure = 2.0
    """Half extent of a point's error body, in standard deviations."""
    min_radius: Measure = 1e-3
    """Smallest half extent of an error body, metres."""
    min_distance: Measure = 1e-3
    """Smallest distance between a point and the mean in the confidence factor, metres."""
    min_share: Share = 0.05
    """A point counts in a cell if the cell's share is at least this fraction of the point's largest share."""
    max_horizontal_radius: Measure = 0.5
    """A point whose error body reaches further horizontally (metres) is rejected as `uncertain`."""
    max_vertical_sigma: Reach = 0.5
    """A point whose height has a larger standard deviation (metres) is rejected as `uncertain`."""
    height_tolerance: Positive = 0.05
    """Full width of the height interval of `confidence_level`: the true mean is within half of it, metres."""
    bounds: MaybeBounds = None
    """xmin, ymin, xmax, ymax in metres: points outside are rejected. Default: none."""
    clear_interval: NotNegative = 0.2
    """Time from one scan of a sensor that clears what it sees through to the next, with `surface = "ground"`."""
    keep: KeepConfig = KeepConfig()
    levels: Annotated[int, Field(ge=1, le=24), NUMBER] = 8
    """Number of levels. Each doubles the cell size of the one before."""
    memory_limit: Size = 2 << 30
    """Resident memory of the process, beyond what it needs without tiles; above it tiles go to the spill file."""
    spill_path: Annotated[str | None, MaybeNone] = None
    """Default: tiles.spill in log.directory."""
    spill_limit: Size = 64 << 30
    """Largest size of the spill file."""
    max_new_tiles: AtLeastOne = 4096
    """A cloud that needs more new tiles is rejected as `too_many_tiles`."""
    max_tiles: AtLeastOne = 4_000_000
    """Most tiles of the map. A cloud that needs more is rejected as `too_many_tiles`."""
    limits: dict[str, Positive] = default_limits(None)
    """Limits of the layer `traversability`: slope in radians, a probability for confidence, the others in metres. Names
    and defaults depend on `surface`. One that is left out has its default with "ground"; with "all" it is not used."""

    @model_validator(mode="before")
    @classmethod
    def _limits_of_the_surface(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        surface = values.get("surface", DEFAULT_SURFACE)
        given = values.get("limits", {} if surface == "ground" else default_limits(surface))
        if surface == "ground" and isinstance(given, dict):
            given = {**default_limits(surface), **given}
        return {**values, "limits": given}

    @model_validator(mode="after")
    def _known_limits(self) -> "MapConfig":
        for name, value in self.limits.items():
            if (fault := fault_of_limit(name, value, self.surface)) is not None:
                raise ValueError(f"map.limits: {fault}")
        return self

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
    """Mode of the Zenoh session."""
    listen: Endpoints = ["tcp/127.0.0.1:7447"]
    """Endpoints to listen on."""
    connect: Endpoints = []
    """Endpoints to connect to."""
    scouting: bool = False
    """Search the network for other Zenoh programs."""
    shared_memory: bool = False
    """Use shared memory on this machine. Zenoh keeps 17 MiB for each process that ever sent a message."""
    config_file: Annotated[str | None, MaybeNone] = None
    """Zenoh configuration file (JSON5)."""
    authority: Annotated[str | None, MaybeNone] = None
    """PEM file of the trusted certificate authority. If set, clients must have a certificate of it."""
    certificate: Annotated[str | None, MaybeNone] = None
    """PEM file of this session's own certificate, for listening and connecting."""
    private_key: Annotated[str | None, MaybeNone] = None
    """PEM file of the certificate's private key."""
    user: Annotated[str | None, MaybeNone] = None
    """User name, for routers that require a password."""
    password: Annotated[SecretStr | None, MaybeNone] = None
    """Environment only: ``ROUGHMAP_ZENOH__PASSWORD``."""
    password_file: Annotated[str | None, MaybeNone] = None
    """File with the password."""

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
    """Longest time that a cloud waits for its poses."""
    max_pose_gap: Positive = 0.5
    """Longest time between two poses that place points between them."""
    pose_history: Positive = 10.0
    """How long poses are kept, counted back from the robot's newest pose."""
    max_speed: Positive = 30.0
    """A pose that moves faster, by more than ``max_leap``, is a leap."""
    max_leap: Positive = 0.3
    """Distance from where the robot's motion would have brought it, beyond which a pose is a leap. Clouds over a leap
    are rejected as `pose_jump`."""
    max_acceleration: Positive = 20.0
    """Acceleration that the robot may have. Half of it times the squared time between poses adds to ``max_leap``."""
    pose_sigma: SixSigmas = (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
    """Standard deviations of poses without a covariance, and of what a covariance does not estimate."""
    placed_sigma: NotNegative = 0.02
    """Standard deviation of points in the map's frame without a covariance, along each axis."""
    max_points: AtLeastOne = 4_000_000
    """Points of a cloud. A larger one is refused as `too_large`."""
    max_message: Size = 64 << 20
    """Bytes of a message. A larger one is refused as `too_large`. One of more than twice the size is dropped by Zenoh
    before it is complete, without an error; only a publisher's numbering shows the gap."""
    queue_limit: Size = 64 << 20
    """Bytes of clouds in the input queue, and of clouds that wait for a decision."""
    duplicates: NotNegativeWhole = 10_000
    """Messages remembered, so that the same bytes sent again enter the map once. The oldest message of the robot with
    the most is forgotten first. A reset of the map forgets all, so a recording can be mapped again."""
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


class UpdatesConfig(Section):
    """The published updates of tiles."""

    layers: Annotated[list[str], Field(min_length=1), Once, AfterValidator(_known_layers)] = [
        "mean_height",
        "range",
        "confidence_factor",
    ]
    """Layers of published tiles."""
    levels: Annotated[list[NotNegativeWhole], Once] = [0]
    """Levels whose tiles are published."""
    update_hz: Positive = 2.0
    """Most updates of a tile per second."""


class QueryConfig(Section):
    """Limits on queries."""

    workers: Annotated[int, Field(ge=1, le=256), NUMBER] = 4
    """Threads that answer queries."""
    max_reply_tiles: AtLeastOne = 1024
    """Most tiles of one answer."""
    max_region_cells: AtLeastOne = 4_000_000
    """Most cells of one region."""
    max_running_cells: AtLeastOne = 16_000_000
    """Cells of all queries that are answered at the same time, 64 bytes each. Cells of a region with more than five
    layers (f4) count several times."""
    queue_limit: AtLeastOne = 64
    """Queries that may wait. Further ones are refused as `busy`."""
    cache_limit: Size = 64 << 20
    """Bytes of encoded tiles kept for repeated queries."""


class LogConfig(Section):
    """The log's files."""

    directory: Annotated[str, Field(min_length=1)] = "log"
    """Folder of the log files."""
    compression: Literal["none", "lz4", "zstd"] = "none"
    """Compression of the log's chunks."""
    flush_interval: Positive = 0.2
    """Longest time until records are written to the file. It is synced every second, and before each receipt."""
    checkpoint_interval: Positive = 1.0
    """Time between two checkpoints."""
    max_file_bytes: Size = 1 << 30
    """Size at which a file ends. It is checked between batches, so a file may be larger by a few hundred messages, or
    with ``updates = "grids"`` by all tiles that changed in one round."""
    max_file_age: Positive = 3600.0
    """Age at which a file ends."""
    keep: Annotated[Size | None, MaybeNone] = None
    """Bytes of all log files in the directory: of all runs, with the current file and what a repair set aside
    (``.torn``, ``.behind``). After each snapshot the oldest files that it does not need are deleted, so between
    snapshots there may be more. Default: keep all."""
    updates: Literal["records", "grids", "none"] = "records"
    """What is logged of published tiles: a record of each, the tiles themselves, or nothing."""
    queries: bool = True
    """Log a record of each query."""
    queue_limit: Size = 128 << 20
    """Bytes that may wait for the disk."""


class StoreConfig(Section):
    """The stored map."""

    path: Annotated[str | None, MaybeNone] = None
    """File of the store, such as map.db. Default: no store; each start rebuilds the map from the log."""
    snapshot_interval: Positive = 10.0
    """Time between two snapshots."""


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
    """Address of the pages, host:port; "" for none."""
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
    """Longest time from SIGTERM to the end of the process."""
    threads: Annotated[int, Field(ge=0, le=1024), NUMBER] = 0
    """Threads that integrate. 0: numba's default."""
    alive_wait: NotNegative = 15.0
    """How long to wait for another instance to go. The token of a killed one stays until its Zenoh lease ends."""
    log_format: Literal["auto", "json", "text"] = "auto"
    """Format of the lines on stderr. "auto" is text on a terminal and JSON elsewhere."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level of the lines on stderr."""
