"""The JSON messages of the contract: receipts, answers, status.

Every model is frozen. Floats are finite or null: JSON never holds NaN. Times are integer
nanoseconds since the Unix epoch and their names end in ``_ns``.
"""

import math
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
)

from roughmap_schemas.contract import CONTRACT_VERSION
from roughmap_schemas.faults import ContractError
from roughmap_schemas.layers import Surface
from roughmap_schemas.reasons import CloudReason, PointReason, PoseReason, Refusal


def _null_if_unknown(value: object) -> object:
    """Turn NaN and infinities into null, so that models take a layer's values as they are."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


Finite = Annotated[float, Field(allow_inf_nan=False)]
Known = Annotated[Finite | None, BeforeValidator(_null_if_unknown)]
"""A float, or null if not known."""

Hex32 = Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
"""128 bits in hexadecimal: an instance, a run, a digest."""

Number = Annotated[int, Field(ge=0)]


def _known_or_text(value: Any, known: ValidatorFunctionWrapHandler) -> Any:
    """Return the member of an enumeration, or the text itself if it is none."""
    try:
        return known(value)
    except ValidationError:
        if isinstance(value, str):
            return value
        raise


OPEN = (WrapValidator(_known_or_text), PlainSerializer(str, return_type=str))
"""Marks a reason. A minor release may add some, so one that this release does not have is read as plain text."""


class Message(BaseModel):
    """The base of all JSON messages.

    Unknown members are ignored, because a minor release of the contract may add some.
    """

    model_config = ConfigDict(
        frozen=True, extra="ignore", use_attribute_docstrings=True, json_schema_serialization_defaults_required=True
    )


class Reply(Message):
    """The base of all JSON replies.

    A member that a minor release of the contract adds here needs a default, so that its clients can read the replies
    of older services.
    """

    contract: Annotated[str, Field(pattern=r"^[0-9]+\.[0-9]+$")] = CONTRACT_VERSION
    """The contract's version, ``major.minor``."""


M = TypeVar("M", bound=Message)


class BadJson(ContractError):
    """A JSON text is not the expected model; the message names the model and the first fault."""


def model_bytes(model: BaseModel) -> bytes:
    """Return the model's JSON in UTF-8, members in declared order."""
    return model.model_dump_json().encode()


def parse_model(kind: type[M], payload: bytes | str) -> M:
    """Read a model from JSON; raises ``BadJson``."""
    try:
        return kind.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "it"
        raise BadJson(f"expected a {kind.__name__} in JSON: {where}: {first['msg']}") from None


class QueryError(Reply):
    """An error reply to any request."""

    code: str
    """A ``QueryCode``; for ingest, a ``Refusal``."""
    message: str


class Receipt(Reply):
    """The reply to an ingested message: it is in the log, on the disk, under this input number."""

    input: Annotated[int, Field(ge=1)]
    epoch: Number
    durable: Literal[True] = True
    duplicate: bool = False


class TileInfo(Reply):
    """The attachment of a tile, region or update. For a region, x, y and digest are null and answer_tiles is 1."""

    map: str
    instance: str
    epoch: Number
    z: Number
    x: int | None
    y: int | None
    sequence: Number
    """Sequence of the last change of the tile's cells or of the ring around it."""
    map_sequence: Number
    """Sequence of the map that this reply shows."""
    answer_tiles: Number
    """Number of replies in the whole answer."""
    oldest_ns: Number
    newest_ns: Number
    known_cells: Number
    digest: str | None
    configuration_digest: str
    compression: Literal["zstd"] | None = None
    """Compression of the Grid's data."""
    surface: Surface = "all"
    """What the cells of the map describe: the ground, or all points together."""


class Hits(Message):
    """Points off the ground of a cell, in a bin of heights."""

    height: Finite
    """The bin's middle, metres in the map's frame."""
    hits: Number
    """At most 15; scans that see through the bin halve it."""


class CellState(Message):
    """A cell's record in the map; with ``surface`` "ground", of the ground alone."""

    count: Number
    updated: Number
    """Stamp of the newest point, in whole seconds since the Unix epoch."""
    weight: Finite
    weight_sq: Finite
    mean: Finite
    m2: Finite
    min: Finite
    max: Finite
    inv_cf: Finite
    variance: Known = 0.0
    """Variance of the mean height from errors that its points have in common: those of the poses."""
    shared: Known = 0.0
    """Covariance of the mean height with the error of the present pose."""
    pose_variance: Known = 0.0
    """Mean variance of the points' heights from the poses."""
    mount_sigma: Known = 0.0
    """Mean standard deviation of the points' heights from the mounting of the sensor."""
    off_ground: list[Hits] = []
    """What was seen above and below the ground, ascending."""


class CellEntry(Message):
    """One place of a query: x, y in metres as asked, its cell, the cell's state (null if unknown) and layers."""

    x: Finite
    y: Finite
    i: int
    j: int
    state: CellState | None
    layers: dict[str, Known]


class CellAnswer(Reply):
    """The answer to a ``cells`` query; places in the order of the query."""

    map: str
    instance: str
    epoch: Number
    sequence: Number
    cells: list[CellEntry]


class QueryRecord(Message):
    """A query in the log: 2,000 characters of its selector, the number of replies, and how long it took."""

    selector: str
    tiles: Number
    sequence: Number
    duration_ns: Number
    outcome: str
    """``ok`` or a ``QueryCode``."""


class UpdateRecord(Message):
    """A published tile in the log, if ``log.updates`` is ``records``."""

    key: str
    info: TileInfo


class ControlAnswer(Reply):
    """The answer to ``snapshot``, ``reset`` or ``forget``."""

    sequence: Number
    epoch: Number
    tiles: Number = 0
    """Tiles that ``forget`` erased."""


class CloudCounts(Message):
    """Clouds since this start."""

    accepted: Number = 0
    waiting: Number = 0
    rejected: dict[Annotated[CloudReason, *OPEN], Number] = {}


class PointCounts(Message):
    """Points of integrated clouds since this start."""

    accepted: Number = 0
    rejected: dict[Annotated[PointReason, *OPEN], Number] = {}


class PoseCounts(Message):
    """Poses since this start."""

    accepted: Number = 0
    rejected: dict[Annotated[PoseReason, *OPEN], Number] = {}


class Lag(Message):
    """Seconds from a cloud's arrival until queries see it, over the last 10 s; null if there was none."""

    p50: Known = None
    p99: Known = None


class Rates(Message):
    """Per second, over the last 10 s."""

    clouds: Finite = 0.0
    points: Finite = 0.0
    poses: Finite = 0.0


class TileCounts(Message):
    """Level-0 tiles in memory and in the spill file."""

    resident: Number = 0
    spilled: Number = 0


class LogState(Message):
    """The file that is being written (null if none), its size so far, whether the last write succeeded, and how fast
    all files together grow."""

    file: str | None = None
    bytes: Number = 0
    ok: bool = True
    bytes_per_hour: Number | None = None
    """Growth over the last minutes; null in the first 10 s."""
    hours_to_full_disk: Annotated[Finite, Field(ge=0)] | None = None
    """Time until the log fills its disk if it goes on so; null if ``log.keep`` bounds it, or if it is unknown."""
    keep: Number | None = None
    """``log.keep`` in bytes; null if all files are kept."""


class MapStatus(Reply):
    """The state of the service and its map; counts are since this start."""

    map: str
    run: str
    instance: str
    epoch: Number
    version: str
    frame_id: str
    cell_size: Finite
    tile_cells: Literal[64] = 64
    levels: Annotated[int, Field(ge=1)]
    layers: list[str]
    bounds: tuple[Finite, Finite, Finite, Finite] | None
    """xmin, ymin, xmax, ymax in metres; null if the map has none."""
    extent: tuple[Finite, Finite, Finite, Finite] | None
    """xmin, ymin, xmax, ymax of the known tiles in metres; null if there are none."""
    error_model: Literal["point", "cuboid", "ellipsoid"]
    surface: Surface = "all"
    """What the cells of the map describe: the ground, or all points together."""
    configuration_digest: str
    health: Literal["ok", "overloaded", "degraded"]
    sequence: Number
    durable_sequence: Number
    input: Number
    newest_stamp_ns: Number
    clouds: CloudCounts
    points: PointCounts
    poses: PoseCounts
    refused: dict[Annotated[Refusal, *OPEN], Number]
    """Messages that never reached the log."""
    gaps: dict[str, Number]
    """Published messages lost on the way, by robot, as the numbers that came with the others show."""
    jumps: dict[str, Number]
    """Leaps of a robot's odometry and of its frame transforms, by robot."""
    problems: Annotated[dict[str, str], Field(max_length=32)] = {}
    """What is wrong, one sentence each with cause and remedy, by subject: "robot r1", "log"."""
    recent: Annotated[list[str], Field(max_length=32)] = []
    """What happened within the last minute and does not make the service degraded, a line each: a pose that leapt."""
    lag_s: Lag
    rates: Rates
    memory_bytes: Number
    tiles: TileCounts
    forgotten: Number = 0
    """Level-0 tiles that were forgotten, by ``map.keep`` or by an operator."""
    log: LogState
    uptime_s: Finite


__all__ = [
    "BadJson",
    "CellAnswer",
    "CellEntry",
    "CellState",
    "CloudCounts",
    "ControlAnswer",
    "Finite",
    "Hex32",
    "Hits",
    "Known",
    "Lag",
    "LogState",
    "MapStatus",
    "Message",
    "Number",
    "PointCounts",
    "PoseCounts",
    "QueryError",
    "QueryRecord",
    "Rates",
    "Receipt",
    "Reply",
    "TileCounts",
    "TileInfo",
    "UpdateRecord",
    "model_bytes",
    "parse_model",
]
