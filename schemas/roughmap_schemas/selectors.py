"""What stands behind the ``?`` of a query: read and written side by side.

``parse`` and ``format`` of each query are each other's inverse. Every fault has a code of the contract.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal, Self, TypeVar

from roughmap_schemas.faults import QueryFault
from roughmap_schemas.keys import canonical_number
from roughmap_schemas.layers import DEFAULT_LAYERS, LAYERS, LIMIT_NAMES
from roughmap_schemas.reasons import QueryCode

MAX_TEXT: Final = 65536
"""Bytes of parameters that are looked at: far beyond any sensible query, and cheap to scan."""

MAX_POINTS: Final = 10_000
"""Places that one ``cells`` query may ask about."""

Dtype = Literal["f4", "f8"]
Compression = Literal["zstd"] | None
Bbox = tuple[float, float, float, float]
Limits = Mapping[str, float]

DECIMAL: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
COUNT: Final = re.compile(r"0|[1-9][0-9]{0,18}")

T = TypeVar("T")


def parse_parameters(text: str) -> dict[str, str]:
    """Split ``name=value`` pairs joined by ``;``, each at its first ``=``.

    Names that begin with ``_`` are Zenoh's and left out. Raises ``QueryFault``: ``too_large`` for a text over
    ``MAX_TEXT``, ``bad_parameter`` for a blank, an empty name, a missing ``=`` or a name that stands twice.
    """
    if len(text) > MAX_TEXT:
        raise QueryFault(QueryCode.TOO_LARGE, f"parameters: expected at most {MAX_TEXT} bytes; found {len(text)}")
    parameters: dict[str, str] = {}
    for part in text.split(";") if text else ():
        name, equals, value = part.partition("=")
        if name.startswith("_"):
            continue
        if not name or not equals:
            raise _bad("parameters", "name=value joined by ;", part)
        if any(letter.isspace() for letter in part):
            raise _bad(name, "a value without blanks", part)
        if name in parameters:
            raise QueryFault(QueryCode.BAD_PARAMETER, f"{_shown(name)}: given twice")
        parameters[name] = value
    return parameters


def format_parameters(parameters: Mapping[str, str]) -> str:
    """Join parameters as ``parse_parameters`` reads them."""
    return ";".join(f"{name}={value}" for name, value in parameters.items())


def _shown(text: str) -> str:
    return repr(text if len(text) <= 80 else text[:77] + "...")


def _bad(name: str, expected: str, found: str) -> QueryFault:
    return QueryFault(QueryCode.BAD_PARAMETER, f"{name}: expected {expected}; found {_shown(found)}")


def _decimal(text: str) -> float | None:
    """Read a finite decimal number; None if it is not one (``float`` alone would take ``1_0``, blanks and ``nan``)."""
    if len(text) > 64 or not DECIMAL.fullmatch(text):
        return None
    value = float(text)
    return value if math.isfinite(value) else None


def _number(value: float) -> str:
    """Write a float so that it reads back as the same one."""
    return repr(float(value))


# One parameter each: read, then written -------------------------------------------------------------------------------


def _parse_layers(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    for name in names:
        if name not in LAYERS:
            raise QueryFault(QueryCode.UNKNOWN_LAYER, f"layers: {_shown(name)} is none of {', '.join(LAYERS)}")
    if len(set(names)) != len(names):
        raise _bad("layers", "each layer once", text)
    return names


def _parse_bbox(text: str) -> Bbox:
    numbers = [_decimal(part) for part in text.split(",", 4)]
    known = [number for number in numbers if number is not None]
    if len(numbers) != 4 or len(known) != 4 or not (known[0] < known[2] and known[1] < known[3]):
        raise QueryFault(
            QueryCode.BAD_BBOX,
            f"bbox: expected xmin,ymin,xmax,ymax, finite, xmin < xmax, ymin < ymax; found {_shown(text)}",
        )
    return known[0], known[1], known[2], known[3]


def _parse_count(name: str) -> Callable[[str], int]:
    def parse(text: str) -> int:
        if not COUNT.fullmatch(text):
            raise _bad(name, "a whole number from 0", text)
        return int(text)

    return parse


def _parse_positive(name: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = _decimal(text)
        if value is None or value <= 0:
            raise _bad(name, "a finite number above 0", text)
        return value

    return parse


def _parse_limits(text: str) -> dict[str, float]:
    limits: dict[str, float] = {}
    for part in text.split(","):
        name, colon, number = part.partition(":")
        value = _decimal(number)
        if not colon or name not in LIMIT_NAMES or name in limits or value is None or value <= 0:
            raise _bad("limits", f"name:number above 0, each name once, of {', '.join(LIMIT_NAMES)}", part)
        limits[name] = value
    return limits


def _parse_dtype(text: str) -> Dtype:
    if text == "f4":
        return "f4"
    if text == "f8":
        return "f8"
    raise _bad("dtype", "f4 or f8", text)


def _parse_compression(text: str) -> Compression:
    if text != "zstd":
        raise _bad("compression", "zstd", text)
    return "zstd"


def _parse_coordinate(name: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        value = _decimal(text)
        if value is None:
            raise _bad(name, "a finite number of metres", text)
        return value

    return parse


class _Reader:
    """Takes parameters one by one, so that what is left over is what nobody knows."""

    def __init__(self, parameters: Mapping[str, str] | str) -> None:
        self.left = parse_parameters(parameters) if isinstance(parameters, str) else dict(parameters)

    def take(self, name: str, parse: Callable[[str], T], otherwise: T) -> T:
        text = self.left.pop(name, None)
        return otherwise if text is None else parse(text)

    def known(self, *names: str) -> None:
        """Refuse unknown names before any value is looked at."""
        for name in self.left:
            if name not in names:
                raise QueryFault(QueryCode.UNKNOWN_PARAMETER, f"{_shown(name)} is none of {', '.join(names)}")


@dataclass(frozen=True, slots=True)
class _Look:
    """What tile and region queries have in common: which layers, computed how, sent how.

    ``tolerance`` (metres) and ``limits`` are the map's where None.
    """

    layers: tuple[str, ...] = DEFAULT_LAYERS
    tolerance: float | None = None
    limits: Limits | None = None
    dtype: Dtype = "f4"
    compression: Compression = None

    def _parts(self) -> dict[str, str]:
        parts = {}
        if self.layers != DEFAULT_LAYERS:
            parts["layers"] = ",".join(self.layers)
        if self.tolerance is not None:
            parts["tolerance"] = _number(self.tolerance)
        if self.limits is not None:
            parts["limits"] = ",".join(f"{name}:{_number(value)}" for name, value in self.limits.items())
        if self.dtype != "f4":
            parts["dtype"] = self.dtype
        if self.compression:
            parts["compression"] = self.compression
        return parts


_LOOK_NAMES = ("layers", "tolerance", "limits", "dtype", "compression")


def _bbox_text(bbox: Iterable[float]) -> str:
    return ",".join(_number(value) for value in bbox)


@dataclass(frozen=True, slots=True)
class TileQuery(_Look):
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
        reader = _Reader(parameters)
        reader.known(*_LOOK_NAMES, "bbox", "since", "epoch")
        since = reader.take("since", _parse_count("since"), None)
        epoch = reader.take("epoch", _parse_count("epoch"), None)
        if since is not None and epoch is None:
            raise QueryFault(QueryCode.BAD_PARAMETER, "since: expected epoch=N with it, of the answer that it is from")
        return cls(
            layers=reader.take("layers", _parse_layers, DEFAULT_LAYERS),
            bbox=reader.take("bbox", _parse_bbox, None),
            since=since,
            epoch=epoch,
            tolerance=reader.take("tolerance", _parse_positive("tolerance"), None),
            limits=reader.take("limits", _parse_limits, None),
            dtype=reader.take("dtype", _parse_dtype, "f4"),
            compression=reader.take("compression", _parse_compression, None),
        )

    def format(self) -> str:
        """Write them."""
        parts = self._parts()
        if self.bbox is not None:
            parts["bbox"] = _bbox_text(self.bbox)
        if self.since is not None:
            parts["since"] = str(self.since)
        if self.epoch is not None:
            parts["epoch"] = str(self.epoch)
        return format_parameters(parts)


@dataclass(frozen=True, slots=True)
class RegionQuery(_Look):
    """The parameters of ``maps/{map}/region``: the cells over ``bbox`` (metres, needed) at ``level``."""

    bbox: Bbox = (0.0, 0.0, 0.0, 0.0)
    level: int = 0

    @classmethod
    def parse(cls, parameters: Mapping[str, str] | str, levels: int) -> Self:
        """Read them for a map of so many levels; raises ``QueryFault``."""
        reader = _Reader(parameters)
        reader.known(*_LOOK_NAMES, "bbox", "level")
        level_text = reader.left.pop("level", "0")
        level = canonical_number(level_text)
        if level is None:
            raise _bad("level", "a whole number from 0", level_text)
        if not 0 <= level < levels:
            raise QueryFault(QueryCode.BAD_LEVEL, f"level: expected 0 to {levels - 1}; found {level}")
        bbox = reader.take("bbox", _parse_bbox, None)
        if bbox is None:
            raise QueryFault(QueryCode.BAD_BBOX, "bbox: expected xmin,ymin,xmax,ymax; found none")
        return cls(
            layers=reader.take("layers", _parse_layers, DEFAULT_LAYERS),
            bbox=bbox,
            level=level,
            tolerance=reader.take("tolerance", _parse_positive("tolerance"), None),
            limits=reader.take("limits", _parse_limits, None),
            dtype=reader.take("dtype", _parse_dtype, "f4"),
            compression=reader.take("compression", _parse_compression, None),
        )

    def format(self) -> str:
        """Write them."""
        parts = self._parts()
        parts["bbox"] = _bbox_text(self.bbox)
        if self.level:
            parts["level"] = str(self.level)
        return format_parameters(parts)
