"""What stands behind the ``?`` of each query: read and written side by side.

``parse`` and ``format`` of each query are each other's inverse. Every fault has a code of the contract.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final, Self

from pydantic import Field, TypeAdapter, ValidationError

from roughmap_schemas.faults import QueryFault
from roughmap_schemas.layers import DEFAULT_LAYERS
from roughmap_schemas.parameters import (
    Bbox,
    Compression,
    Dtype,
    Limits,
    Reader,
    format_bbox,
    format_limits,
    format_parameters,
    number,
    parse_bbox,
    parse_compression,
    parse_coordinate,
    parse_count,
    parse_dtype,
    parse_layers,
    parse_limits,
    parse_parameters,
    parse_positive,
    parse_whole,
)
from roughmap_schemas.reasons import QueryCode

MAX_POINTS: Final = 10_000
"""Places that one ``cells`` query may ask about."""

MAX_PLACES_TEXT: Final = 1 << 20
"""Bytes of JSON that are looked at for them: a hundred a place."""

Place = tuple[float, float]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_PLACES: Final[TypeAdapter[list[Place]]] = TypeAdapter(list[tuple[Metres, Metres]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What all queries have in common: which layers, computed how.

    ``tolerance`` (the full width, metres) and ``limits`` are the map's where None.
    """

    layers: tuple[str, ...] = DEFAULT_LAYERS
    tolerance: float | None = None
    limits: Limits | None = None

    def parts(self) -> dict[str, str]:
        """Give the parameters that differ from their defaults."""
        parts = {}
        if self.layers != DEFAULT_LAYERS:
            parts["layers"] = ",".join(self.layers)
        if self.tolerance is not None:
            parts["tolerance"] = number(self.tolerance)
        if self.limits is not None:
            parts["limits"] = format_limits(self.limits)
        return parts


@dataclass(frozen=True, slots=True, kw_only=True)
class GridLook(Look):
    """What the queries have in common that are answered by grids: the numbers' type and the data's compression."""

    dtype: Dtype = "f4"
    compression: Compression = None

    def parts(self) -> dict[str, str]:
        """Give the parameters that differ from their defaults."""
        parts = Look.parts(self)
        if self.dtype != "f4":
            parts["dtype"] = self.dtype
        if self.compression is not None:
            parts["compression"] = self.compression
        return parts


LOOK: Final = ("layers", "tolerance", "limits")
GRID_LOOK: Final = (*LOOK, "dtype", "compression")


def _layers(reader: Reader) -> tuple[str, ...]:
    return reader.take("layers", parse_layers, DEFAULT_LAYERS)


def _tolerance(reader: Reader) -> float | None:
    return reader.take("tolerance", parse_positive("tolerance"), None)


def _limits(reader: Reader) -> Limits | None:
    return reader.take("limits", parse_limits, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class TileQuery(GridLook):
    """The parameters of ``maps/{map}/tiles/...``.

    ``bbox`` is xmin, ymin, xmax, ymax in metres of the map frame, at every level; None is the whole map. ``since`` and
    ``epoch`` name the state that the asker already has.
    """

    bbox: Bbox | None = None
    since: int | None = None
    epoch: int | None = None

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str) -> Self:
        """Read them; raises ``QueryFault``."""
        reader = Reader(parameters, *GRID_LOOK, "bbox", "since", "epoch")
        since = reader.take("since", parse_count("since"), None)
        epoch = reader.take("epoch", parse_count("epoch"), None)
        if since is not None and epoch is None:
            raise QueryFault(QueryCode.BAD_PARAMETER, "since: expected epoch=N with it, of the answer that it is from")
        return cls(
            layers=_layers(reader),
            bbox=reader.take("bbox", parse_bbox, None),
            since=since,
            epoch=epoch,
            tolerance=_tolerance(reader),
            limits=_limits(reader),
            dtype=reader.take("dtype", parse_dtype, "f4"),
            compression=reader.take("compression", parse_compression, None),
        )

    def format(self) -> str:
        """Write them."""
        parts = self.parts()
        if self.bbox is not None:
            parts["bbox"] = format_bbox(self.bbox)
        if self.since is not None:
            parts["since"] = str(self.since)
        if self.epoch is not None:
            parts["epoch"] = str(self.epoch)
        return format_parameters(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionQuery(GridLook):
    """The parameters of ``maps/{map}/region``: the cells over ``bbox`` (metres) at ``level``."""

    bbox: Bbox
    level: int = 0

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str, levels: int) -> Self:
        """Read them for a map of so many levels; raises ``QueryFault``."""
        reader = Reader(parameters, *GRID_LOOK, "bbox", "level")
        level = reader.take("level", parse_whole("level"), 0)
        if not 0 <= level < levels:
            raise QueryFault(QueryCode.BAD_LEVEL, f"level: expected 0 to {levels - 1}; found {level}")
        bbox = reader.take("bbox", parse_bbox, None)
        if bbox is None:
            raise QueryFault(QueryCode.BAD_BBOX, "bbox: expected xmin,ymin,xmax,ymax; found none")
        return cls(
            layers=_layers(reader),
            bbox=bbox,
            level=level,
            tolerance=_tolerance(reader),
            limits=_limits(reader),
            dtype=reader.take("dtype", parse_dtype, "f4"),
            compression=reader.take("compression", parse_compression, None),
        )

    def format(self) -> str:
        """Write them."""
        parts = self.parts()
        parts["bbox"] = format_bbox(self.bbox)
        if self.level:
            parts["level"] = str(self.level)
        return format_parameters(parts)


@dataclass(frozen=True, slots=True, kw_only=True)
class CellsQuery(Look):
    """What ``maps/{map}/cells`` is asked: places (x, y) in metres, one in the parameters or any number as JSON."""

    points: tuple[Place, ...] = ()

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str, payload: bytes = b"") -> Self:
        """Read them; raises ``QueryFault``."""
        reader = Reader(parameters, *LOOK, "x", "y")
        x = reader.take("x", parse_coordinate("x"), None)
        y = reader.take("y", parse_coordinate("y"), None)
        layers, tolerance, limits = _layers(reader), _tolerance(reader), _limits(reader)
        if x is not None and y is not None and not payload:
            points: tuple[Place, ...] = ((x, y),)
        elif x is None and y is None and payload:
            points = cls._parse_payload(payload)
        else:
            raise QueryFault(
                QueryCode.BAD_PARAMETER, "expected x=..;y=.. or JSON [[x, y], ...] in the payload, and not both"
            )
        return cls(layers=layers, tolerance=tolerance, limits=limits, points=points)

    @staticmethod
    def _parse_payload(payload: bytes) -> tuple[Place, ...]:
        if len(payload) > MAX_PLACES_TEXT:
            raise QueryFault(
                QueryCode.TOO_LARGE, f"payload: expected at most {MAX_PLACES_TEXT} bytes; found {len(payload)}"
            )
        try:
            points = _PLACES.validate_json(payload)
        except ValidationError:
            raise QueryFault(
                QueryCode.BAD_PARAMETER, "payload: expected JSON [[x, y], ...] of finite numbers; found something else"
            ) from None
        if len(points) > MAX_POINTS:
            raise QueryFault(QueryCode.TOO_LARGE, f"payload: expected at most {MAX_POINTS} places; found {len(points)}")
        return tuple(points)

    def format(self) -> tuple[str, bytes]:
        """Write the parameters and the payload (empty for a single place)."""
        parts = self.parts()
        if len(self.points) == 1:
            (x, y) = self.points[0]
            parts["x"], parts["y"] = number(x), number(y)
            return format_parameters(parts), b""
        return format_parameters(parts), _PLACES.dump_json(list(self.points))


__all__ = [
    "MAX_POINTS",
    "Bbox",
    "CellsQuery",
    "Compression",
    "Dtype",
    "GridLook",
    "Limits",
    "Look",
    "RegionQuery",
    "TileQuery",
    "parse_parameters",
]
