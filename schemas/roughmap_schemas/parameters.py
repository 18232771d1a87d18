"""The parameters of queries, ``name=value`` joined by ``;``: each is read and written here."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Final, Literal, TypeVar

from roughmap_schemas.faults import QueryFault
from roughmap_schemas.layers import LAYERS, LIMIT_NAMES
from roughmap_schemas.reasons import QueryCode

MAX_TEXT: Final = 65536
"""Longest text of parameters that is parsed: far beyond any sensible query, and cheap to scan."""

Dtype = Literal["f4", "f8"]
Compression = Literal["zstd"] | None
Bbox = tuple[float, float, float, float]
Limits = Mapping[str, float]

DECIMAL: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?")
COUNT: Final = re.compile(r"0|[1-9][0-9]{0,18}")
WHOLE: Final = re.compile(r"0|-?[1-9][0-9]{0,18}")

T = TypeVar("T")


def parse_parameters(text: str) -> dict[str, str]:
    """Split ``name=value`` pairs joined by ``;``, each at its first ``=``.

    Names that begin with ``_`` are Zenoh's and left out. Raises ``QueryFault``: ``too_large`` for a text over
    ``MAX_TEXT``, ``bad_parameter`` for a blank, an empty name, a missing value or a name given twice; but ``bad_bbox``
    for a blank in ``bbox`` or no value of it.
    """
    if len(text) > MAX_TEXT:
        raise QueryFault(QueryCode.TOO_LARGE, f"parameters: expected at most {MAX_TEXT} bytes; found {len(text)}")
    parameters: dict[str, str] = {}
    for part in text.split(";") if text else ():
        name, equals, value = part.partition("=")
        if name.startswith("_"):
            continue
        if name == "bbox" and not equals:  # also ``bbox=``: Zenoh removes the = of an empty value
            raise QueryFault(QueryCode.BAD_BBOX, "bbox: expected xmin,ymin,xmax,ymax; found none")
        if name and not equals:  # also ``name=``, as above
            raise QueryFault(QueryCode.BAD_PARAMETER, f"{name[:80]}: expected {name[:80]}=VALUE; found no value")
        if not name:
            raise bad("parameters", "name=value, several with ';' between them", part)
        if any(letter.isspace() for letter in part):
            code = QueryCode.BAD_BBOX if name == "bbox" else QueryCode.BAD_PARAMETER
            raise QueryFault(code, f"{name[:80]}: expected a value without blanks; found {shown(part)}")
        if name in parameters:
            raise QueryFault(QueryCode.BAD_PARAMETER, f"{shown(name)}: given twice")
        parameters[name] = value
    return parameters


def format_parameters(parameters: Mapping[str, str]) -> str:
    """Join parameters as ``parse_parameters`` reads them."""
    return ";".join(f"{name}={value}" for name, value in parameters.items())


def shown(text: str) -> str:
    """Quote what was found, shortened: an error reply must not echo a text of any length."""
    return repr(text if len(text) <= 80 else text[:77] + "...")


def bad(name: str, expected: str, found: str) -> QueryFault:
    """Return the fault for a value that doesn't parse."""
    return QueryFault(QueryCode.BAD_PARAMETER, f"{name[:80]}: expected {expected}; found {shown(found)}")


def decimal(text: str) -> float | None:
    """Read a finite decimal number; None if it is not one (``float`` alone would take ``1_0``, blanks and ``nan``)."""
    if len(text) > 64 or not DECIMAL.fullmatch(text):
        return None
    value = float(text)
    return value if math.isfinite(value) else None


def number(value: float) -> str:
    """Write a float so that it reads back as the same one."""
    return repr(float(value))


# Each parameter: read, then written -----------------------------------------------------------------------------------


def parse_layers(text: str) -> tuple[str, ...]:
    """Read ``layers``: known names, each once, in the asked order."""
    names = tuple(text.split(","))
    for name in names:
        if name not in LAYERS:
            raise QueryFault(QueryCode.UNKNOWN_LAYER, f"layers: expected {', '.join(LAYERS)}; found {shown(name)}")
    if len(set(names)) != len(names):
        raise bad("layers", "each layer once", text)
    return names


def parse_bbox(text: str) -> Bbox:
    """Read ``bbox``: four finite numbers, each minimum below its maximum; any fault is ``bad_bbox``."""
    parts = [decimal(part) for part in text.split(",", 4)]
    known = [part for part in parts if part is not None]
    if len(parts) != 4 or len(known) != 4 or not (known[0] < known[2] and known[1] < known[3]):
        raise QueryFault(
            QueryCode.BAD_BBOX,
            f"bbox: expected xmin,ymin,xmax,ymax, finite, xmin < xmax, ymin < ymax; found {shown(text)}",
        )
    return known[0], known[1], known[2], known[3]


def format_bbox(bbox: Iterable[float]) -> str:
    """Write ``bbox``."""
    return ",".join(number(value) for value in bbox)


def parse_count(name: str) -> Callable[[str], int]:
    """Return a parser of whole numbers from 0."""

    def parse(text: str) -> int:
        if not COUNT.fullmatch(text):
            raise bad(name, "a whole number from 0", text)
        return int(text)

    return parse


def parse_whole(name: str) -> Callable[[str], int]:
    """Return a parser of whole numbers of either sign. Their range is checked elsewhere, under another code."""

    def parse(text: str) -> int:
        if not WHOLE.fullmatch(text):
            raise bad(name, "a whole number", text)
        return int(text)

    return parse


def parse_positive(name: str) -> Callable[[str], float]:
    """Return a parser of finite numbers above 0."""

    def parse(text: str) -> float:
        value = decimal(text)
        if value is None or value <= 0:
            raise bad(name, "a finite number above 0", text)
        return value

    return parse


def parse_coordinate(name: str) -> Callable[[str], float | None]:
    """Return a parser of finite numbers of metres."""

    def parse(text: str) -> float:
        value = decimal(text)
        if value is None:
            raise bad(name, "a finite number of metres", text)
        return value

    return parse


def parse_limits(text: str) -> Limits:
    """Read ``limits``: ``name:number`` joined by ``,``. Which of the names a map has depends on its surface."""
    limits: dict[str, float] = {}
    known = list(dict.fromkeys(name for names in LIMIT_NAMES.values() for name in names))
    for part in text.split(","):
        name, colon, digits = part.partition(":")
        value = decimal(digits)
        if not colon or name not in known or name in limits or value is None or value <= 0:
            raise bad("limits", f"name:number above 0, each name once, of {', '.join(known)}", part)
        limits[name] = value
    return limits


def format_limits(limits: Limits) -> str:
    """Write ``limits``."""
    return ",".join(f"{name}:{number(value)}" for name, value in limits.items())


def parse_dtype(text: str) -> Dtype:
    """Read ``dtype``."""
    if text == "f4":
        return "f4"
    if text == "f8":
        return "f8"
    raise bad("dtype", "f4 or f8", text)


def parse_compression(text: str) -> Compression:
    """Read ``compression``."""
    if text != "zstd":
        raise bad("compression", "zstd", text)
    return "zstd"


class ParameterReader:
    """Takes parameters one by one; raises ``QueryFault`` (``unknown_parameter``) for names other than ``names``."""

    def __init__(self, parameters: Mapping[str, str] | str, *names: str) -> None:
        self.left = parse_parameters(parameters) if isinstance(parameters, str) else dict(parameters)
        for name in self.left:
            if name not in names:
                raise QueryFault(QueryCode.UNKNOWN_PARAMETER, f"expected {', '.join(names)}; found {shown(name)}")

    def take(self, name: str, parse: Callable[[str], T], otherwise: T) -> T:
        """Return a parameter's value, or ``otherwise`` if it is not given."""
        text = self.left.get(name)
        return otherwise if text is None else parse(text)
