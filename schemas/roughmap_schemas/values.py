"""The types of settings: numbers with their ranges, sizes, names."""

import math
import re
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from roughmap_schemas.geometry import normalised
from roughmap_schemas.keys import NAME_PATTERN

UNITS: Final = {
    "": 1,
    "b": 1,
    "kb": 10**3,
    "mb": 10**6,
    "gb": 10**9,
    "tb": 10**12,
    "kib": 2**10,
    "mib": 2**20,
    "gib": 2**30,
    "tib": 2**40,
}
SIZE: Final = re.compile(r"([0-9]{1,15}(?:\.[0-9]{1,6})?) ?([A-Za-z]{0,3})")


def _no_bool(value: object) -> object:
    """Refuse true and false for a number; pydantic would read them as 1 and 0."""
    if isinstance(value, bool):
        raise ValueError("must be a number")
    return value


def parse_size(value: object) -> int:
    """Read a size in bytes: a whole number, or a text such as ``64MiB``, ``1.5GiB`` or ``100MB``. Raises ValueError."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    match = SIZE.fullmatch(value.strip()) if isinstance(value, str) else None
    if match is None or match[2].lower() not in UNITS:
        raise ValueError('must be a number of bytes or a text such as "64MiB" (B, kB, MB, GB, TB, KiB, MiB, GiB, TiB)')
    size = float(match[1]) * UNITS[match[2].lower()] if "." in match[1] else int(match[1]) * UNITS[match[2].lower()]
    return int(size)


def _nothing(value: object) -> object:
    """Read "" as none."""
    return None if value == "" else value


def _unit(value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    unit = normalised(value)
    if unit is None:
        raise ValueError("must be x, y, z, w of norm at least 1e-6")
    return unit


def _box(value: tuple[float, ...]) -> tuple[float, ...]:
    half = len(value) // 2
    if not all(low < high for low, high in zip(value[:half], value[half:], strict=True)):
        raise ValueError("must have each minimum below its maximum")
    return value


def _once(value: list[Any]) -> list[Any]:
    if len({str(item) for item in value}) != len(value):
        raise ValueError("must have each value once")
    return value


NUMBER: Final = BeforeValidator(_no_bool)
"""Must be last in an annotation, so that the ranges before it stay part of the number's JSON Schema."""

Real = Annotated[float, Field(allow_inf_nan=False), NUMBER]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), NUMBER]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), NUMBER]
LEAST: Final = 1e-30
Measure = Annotated[float, Field(ge=LEAST, le=1e30), NUMBER]
"""A number above 0 whose squares and cubes are finite and not 0 in float64, as the map core requires of lengths."""
Share = Annotated[float, Field(ge=0, le=1), NUMBER]
# JSON has no infinity: there it is the text "inf".
Reach = Annotated[
    float,
    Field(gt=0),
    BeforeValidator(_no_bool, json_schema_input_type=Annotated[float, Field(gt=0)] | Literal["inf"]),
]
"""A distance that may be infinite. NaN is refused, since it is not above 0."""
Ceiling = Annotated[
    float, Field(gt=-math.inf), BeforeValidator(_no_bool, json_schema_input_type=float | Literal["inf"])
]

Up = Annotated[float, Field(ge=0, le=90), NUMBER]
Aside = Annotated[float, Field(ge=0, le=180), NUMBER]
MaybeView = Annotated[
    tuple[Up, Up, Aside, Aside] | None,
    BeforeValidator(_nothing, json_schema_input_type=tuple[Up, Up, Aside, Aside] | Literal[""] | None),
]
"""A field of view in degrees, up, down, left, right; "" for none."""

AtLeastOne = Annotated[int, Field(ge=1), NUMBER]
NotNegativeWhole = Annotated[int, Field(ge=0), NUMBER]
Size = Annotated[int, Field(ge=1), BeforeValidator(parse_size, json_schema_input_type=int | str)]
Name = Annotated[str, Field(pattern=NAME_PATTERN.replace(r"\Z", "$"))]
Frame = Annotated[str, Field(min_length=1, max_length=256)]

Three = tuple[Real, Real, Real]
SixSigmas = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]
Rotation = Annotated[tuple[Real, Real, Real, Real], AfterValidator(_unit)]
Bounds = Annotated[tuple[Real, Real, Real, Real], AfterValidator(_box)]
Box = Annotated[tuple[Real, Real, Real, Real, Real, Real], AfterValidator(_box)]
MaybeNone = BeforeValidator(_nothing)
"""Lets "" mean none."""
MaybeBounds = Annotated[
    Bounds | None, BeforeValidator(_nothing, json_schema_input_type=tuple[Real, Real, Real, Real] | Literal[""] | None)
]

Once = AfterValidator(_once)
"""Refuses a list with the same value twice."""
