"""The parameters behind the ``?`` of each query. ``parse`` and ``format`` are inverses."""

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
    ParameterReader,
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
"""Places of one ``cells`` query."""

MAX_PLACES_TEXT: Final = 1 << 20
"""Bytes of JSON for them: a hundred per place."""

Place = tuple[float, float]
Metres = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_PLACES: Final[TypeAdapter[list[Place]]] = TypeAdapter(list[tuple[Metres, Metres]])


@dataclass(frozen=True, slots=True, kw_only=True)
class LayersQuery:
    """What all queries have in common: the layers, and how they are computed.

    ``tolerance`` is the full width in metres. ``tolerance`` and ``limits`` are the map's if None.
    """

    layers: tuple[str, ...] = DEFAULT_LAYERS
    tolerance: float | None = None
    limits: Limits | None = None

    def parts(self) -> dict[str, str]:
        """Return the parameters that differ from their defaults."""
        parts = {}
        if self.layers != DEFAULT_LAYERS:
            parts["layers"] = ",".join(self.layers)
        if self.tolerance is not None:
            parts["tolerance"] = number(self.tolerance)
        if self.limits is not None:
            parts["limits"] = format_limits(self.limits)
        return parts


@dataclass(frozen=True, slots=True, kw_only=True)
class GridsQuery(LayersQuery):
    """What queries answered by grids have in common: the type of numbers and the compression of the data."""

    dtype: Dtype = "f4"
    compression: Compression = None

    def parts(self) -> dict[str, str]:
        """Return the parameters that differ from their defaults."""
        parts = LayersQuery.parts(self)
        if self.dtype != "f4":
            parts["dtype"] = self.dtype
        if self.compression is not None:
            parts["compression"] = self.compression
        return parts


LAYERS_NAMES: Final = ("layers", "tolerance", "limits")
GRIDS_NAMES: Final = (*LAYERS_NAMES, "dtype", "compression")


def _layers(reader: ParameterReader) -> tuple[str, ...]:
    return reader.take("layers", parse_layers, DEFAULT_LAYERS)


def _tolerance(reader: ParameterReader) -> float | None:
    return reader.take("tolerance", parse_positive("tolerance"), None)


def _limits(reader: ParameterReader) -> Limits | None:
    return reader.take("limits", parse_limits, None)


@dataclass(frozen=True, slots=True, kw_only=True)
class TileQuery(GridsQuery):
    """The parameters of ``maps/{map}/tiles/...``.

    ``bbox`` is xmin, ymin, xmax, ymax in metres of the map frame, at every level; None is the whole map. ``since`` and
    ``epoch`` name the state that the client already has.
    """

    bbox: Bbox | None = None
    since: int | None = None
    epoch: int | None = None

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str) -> Self:
        """Read them; raises ``QueryFault``."""
        reader = ParameterReader(parameters, *GRIDS_NAMES, "bbox", "since", "epoch")
        since = reader.take("since", parse_count("since"), None)
        epoch = reader.take("epoch", parse_count("epoch"), None)
        if since is not None and epoch is None:
            raise QueryFault(QueryCode.BAD_PARAMETER, "since: expected epoch=N of the same answer with it; found none")
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
class RegionQuery(GridsQuery):
    """The parameters of ``maps/{map}/region``: the cells over ``bbox`` (metres) at ``level``."""

    bbox: Bbox
    level: int = 0

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str, levels: int) -> Self:
        """Read them for a map with ``levels`` levels; raises ``QueryFault``."""
        reader = ParameterReader(parameters, *GRIDS_NAMES, "bbox", "level")
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
class CellsQuery(LayersQuery):
    """A query of ``maps/{map}/cells``: places (x, y) in metres, one in the parameters or several as JSON payload."""

    points: tuple[Place, ...] = ()

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str, payload: bytes = b"") -> Self:
        """Read them; raises ``QueryFault``."""
        reader = ParameterReader(parameters, *LAYERS_NAMES, "x", "y")
        x = reader.take("x", parse_coordinate("x"), None)
        y = reader.take("y", parse_coordinate("y"), None)
        layers, tolerance, limits = _layers(reader), _tolerance(reader), _limits(reader)
        if x is not None and y is not None and not payload:
            points: tuple[Place, ...] = ((x, y),)
        elif x is None and y is None and payload:
            points = cls._parse_payload(payload)
        else:
            raise QueryFault(QueryCode.BAD_PARAMETER, "expected either x=..;y=.. or JSON [[x, y], ...] in the payload")
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
                QueryCode.BAD_PARAMETER, "payload: expected JSON [[x, y], ...] of finite numbers"
            ) from None
        if len(points) > MAX_POINTS:
            raise QueryFault(QueryCode.TOO_LARGE, f"payload: expected at most {MAX_POINTS} places; found {len(points)}")
        return tuple(points)

    def format(self) -> tuple[str, bytes]:
        """Return the parameters and the payload, which is empty for a single place."""
        parts = self.parts()
        if len(self.points) == 1:
            (x, y) = self.points[0]
            parts["x"], parts["y"] = number(x), number(y)
            return format_parameters(parts), b""
        return format_parameters(parts), _PLACES.dump_json(list(self.points))


@dataclass(frozen=True, slots=True, kw_only=True)
class ForgetQuery:
    """The parameters of ``maps/{map}/control/forget``: which tiles are erased.

    Those that meet ``bbox`` (xmin, ymin, xmax, ymax in metres), those without a point in the last ``older`` seconds,
    or, with both, those that are both.
    """

    bbox: Bbox | None = None
    older: float | None = None

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str) -> Self:
        """Read them; raises ``QueryFault``."""
        reader = ParameterReader(parameters, "bbox", "older")
        asked = cls(
            bbox=reader.take("bbox", parse_bbox, None), older=reader.take("older", parse_positive("older"), None)
        )
        if asked.bbox is None and asked.older is None:
            raise QueryFault(
                QueryCode.BAD_PARAMETER,
                "forget: expected bbox=xmin,ymin,xmax,ymax, older=SECONDS or both; found none (a reset forgets all)",
            )
        return asked

    def format(self) -> str:
        """Write them."""
        parts = {} if self.bbox is None else {"bbox": format_bbox(self.bbox)}
        return format_parameters(parts if self.older is None else {**parts, "older": number(self.older)})


__all__ = [
    "MAX_POINTS",
    "Bbox",
    "CellsQuery",
    "Compression",
    "Dtype",
    "ForgetQuery",
    "GridsQuery",
    "LayersQuery",
    "Limits",
    "RegionQuery",
    "TileQuery",
    "parse_parameters",
]
