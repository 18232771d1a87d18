"""Key expressions: made and parsed by the same templates."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import takewhile
from typing import Final

from roughmap_schemas.faults import ConfigFault, MessageFault, QueryFault
from roughmap_schemas.reasons import QueryCode, Refusal

NAME_PATTERN: Final = r"^[A-Za-z0-9_.-]{1,64}\Z"
"""Names of maps, robots and service instances."""

NAME_WORDS: Final = "1 to 64 of the letters A-Z and a-z, digits, '_', '.' and '-'"
"""The same in words."""

NAME: Final = re.compile(NAME_PATTERN)
NUMBER: Final = re.compile(r"-?(?:0|[1-9][0-9]{0,9})")
"""A number in a key, at most ten digits; ``-0`` is refused separately."""

TEMPLATES: Final[Mapping[str, str]] = {
    "points": "robots/{robot}/points",
    "odometry": "robots/{robot}/odometry",
    "transform": "robots/{robot}/transform",
    "trajectory": "robots/{robot}/trajectory",
    "ingest_points": "maps/{map}/ingest/{robot}/points",
    "ingest_odometry": "maps/{map}/ingest/{robot}/odometry",
    "ingest_transform": "maps/{map}/ingest/{robot}/transform",
    "tiles": "maps/{map}/tiles/{z}/{x}/{y}",
    "region": "maps/{map}/region",
    "cells": "maps/{map}/cells",
    "updates": "maps/{map}/updates/{z}/{x}/{y}",
    "events": "maps/{map}/events",
    "status": "maps/{map}/status",
    "control": "maps/{map}/control/{action}",
    "alive": "maps/{map}/alive/{instance}",
    "queries": "maps/{map}/queries",
}
"""The default of every key expression. ``queries`` is a topic of the log only."""

INGEST: Final = ("points", "odometry", "transform")
"""Kinds of messages that can be ingested."""

_FILLED: Final[Mapping[str, frozenset[str]]] = {
    name: frozenset(re.findall(r"\{(\w+)\}", template)) - {"map"} for name, template in TEMPLATES.items()
}

Selected = tuple[int | None, int | None, int | None]
"""Level, x and y of the tiles that a key expression selects; None is any."""


def check_template(name: str, template: str) -> None:
    """Raise ``ConfigFault`` unless ``template`` is a key with each placeholder once, as a whole chunk."""
    chunks = template.split("/")
    found = [chunk[1:-1] for chunk in chunks if chunk.startswith("{") and chunk.endswith("}")]
    needed = sorted(_FILLED[name])
    plain = [chunk for chunk in chunks if not (chunk.startswith("{") and chunk.endswith("}"))]
    if not all(chunk and not set(chunk) & set("*$?#{}") for chunk in plain):
        raise ConfigFault(f"keys.{name}: {template!r} is not a key (allowed: non-empty chunks joined by /, no * $ ? #)")
    if sorted(set(found) - {"map"}) != needed or len(found) != len(set(found)):
        wanted = ", ".join(f"{{{part}}}" for part in needed) or "no placeholder"
        raise ConfigFault(f"keys.{name}: {template!r} must have {wanted} once each, as whole chunks")


def canonical_number(text: str) -> int | None:
    """Read a number as keys write it: int32, no ``+``, no leading zero, no ``-0``. None if it is not one."""
    if not NUMBER.fullmatch(text) or text == "-0":
        return None
    value = int(text)
    return value if -(2**31) <= value < 2**31 else None


@dataclass(frozen=True, slots=True)
class KeyForm:
    """One key expression of a map; ``make`` and ``parse`` are inverses."""

    name: str
    chunks: tuple[str, ...]

    def make(self, **values: object) -> str:
        """Return the key with all placeholders filled; ``values`` must name exactly these."""
        return "/".join(str(values[chunk[1:-1]]) if chunk.startswith("{") else chunk for chunk in self.chunks)

    def any(self) -> str:
        """Return the key expression that matches all values."""
        return "/".join("*" if chunk.startswith("{") else chunk for chunk in self.chunks)

    def parse(self, key: str) -> dict[str, str] | None:
        """Return the values of a key's placeholders; None if it is not of this form."""
        parts = key.split("/")
        if len(parts) != len(self.chunks):
            return None
        values: dict[str, str] = {}
        for chunk, part in zip(self.chunks, parts, strict=True):
            if chunk.startswith("{"):
                values[chunk[1:-1]] = part
            elif chunk != part:
                return None
        return values


class Keys:
    """All key expressions of one map. Raises ``ConfigFault`` for an invalid name or template."""

    def __init__(self, map_name: str, templates: Mapping[str, str] | None = None) -> None:
        if not NAME.fullmatch(map_name):
            raise ConfigFault(f"map.name: {map_name[:80]!r} must be {NAME_WORDS}")
        self.map_name = map_name
        self._forms: dict[str, KeyForm] = {}
        given = {**TEMPLATES, **(templates or {})}
        for name, template in given.items():
            if name not in TEMPLATES:
                raise ConfigFault(f"keys.{name}: unknown (allowed: {', '.join(TEMPLATES)})")
            check_template(name, template)
            chunks = tuple(map_name if chunk == "{map}" else chunk for chunk in template.split("/"))
            self._forms[name] = KeyForm(name, chunks)
        self.points_any = self._forms["points"].any()
        self.odometry_any = self._forms["odometry"].any()
        self.transform_any = self._forms["transform"].any()
        self.ingest_any = self._ingest_any()
        self.tiles_any = self._forms["tiles"].any()
        self.updates_any = self._forms["updates"].any()
        self.alive_any = self._forms["alive"].any()
        self.region = self._forms["region"].make()
        self.cells = self._forms["cells"].make()
        self.events = self._forms["events"].make()
        self.status = self._forms["status"].make()
        self.queries = self._forms["queries"].make()
        self.updates_topic = "/".join(c for c in self._forms["updates"].chunks if not c.startswith("{"))

    def form(self, name: str) -> KeyForm:
        """Return the form with that name, a key of ``TEMPLATES``."""
        return self._forms[name]

    # Inputs ---------------------------------------------------------------------------------------------------------

    def _robot(self, name: str, key: str) -> str:
        values = self._forms[name].parse(key)
        if values is None or not NAME.fullmatch(values["robot"]):
            expected = self._forms[name].make(robot="{robot}")
            raise MessageFault(
                Refusal.BAD_KEY,
                f"expected {expected} with a robot's name ({NAME_WORDS}), no wildcard; found {key[:200]!r}",
            )
        return values["robot"]

    def points(self, robot: str) -> str:
        """Return the key of a robot's clouds."""
        return self._forms["points"].make(robot=robot)

    def parse_points(self, key: str) -> str:
        """Return the robot of a cloud's key; raises ``MessageFault`` (``bad_key``)."""
        return self._robot("points", key)

    def odometry(self, robot: str) -> str:
        """Return the key of a robot's poses."""
        return self._forms["odometry"].make(robot=robot)

    def parse_odometry(self, key: str) -> str:
        """Return the robot of a pose's key; raises ``MessageFault`` (``bad_key``)."""
        return self._robot("odometry", key)

    def transform(self, robot: str) -> str:
        """Return the key of a robot's frame transforms."""
        return self._forms["transform"].make(robot=robot)

    def parse_transform(self, key: str) -> str:
        """Return the robot of a transform's key; raises ``MessageFault`` (``bad_key``)."""
        return self._robot("transform", key)

    def ingest_points(self, robot: str) -> str:
        """Return the key on which a robot's clouds are ingested."""
        return self._forms["ingest_points"].make(robot=robot)

    def ingest_odometry(self, robot: str) -> str:
        """Return the key on which a robot's poses are ingested."""
        return self._forms["ingest_odometry"].make(robot=robot)

    def ingest_transform(self, robot: str) -> str:
        """Return the key on which a robot's transforms are ingested."""
        return self._forms["ingest_transform"].make(robot=robot)

    def parse_ingest(self, key: str) -> tuple[str, str]:
        """Return kind (of ``INGEST``) and robot of an ingest key; raises ``MessageFault`` (``bad_key``)."""
        forms = {kind: self._forms[f"ingest_{kind}"] for kind in INGEST}
        for kind, form in forms.items():
            values = form.parse(key)
            if values is not None and NAME.fullmatch(values["robot"]):
                return kind, values["robot"]
        expected = ", ".join(form.make(robot="{robot}") for form in forms.values())
        raise MessageFault(
            Refusal.BAD_KEY,
            f"expected one of {expected} with a robot's name ({NAME_WORDS}), no wildcard; found {key[:200]!r}",
        )

    def _ingest_any(self) -> list[str]:
        """Return one key expression over everything under the ingest keys' common prefix, so that a mistyped key gets
        an error; or one per kind, if they have no common prefix or share it with other keys."""
        forms = [self._forms[f"ingest_{kind}"] for kind in INGEST]
        columns = zip(*(form.chunks for form in forms), strict=False)
        begin = [chunks[0] for chunks in takewhile(lambda c: len({*c}) == 1 and not c[0].startswith("{"), columns)]
        others = [form.chunks[: len(begin)] for form in self._forms.values() if form not in forms]
        if any(all(c == b or c.startswith("{") for c, b in zip(chunks, begin, strict=False)) for chunks in others):
            return [form.any() for form in forms]
        return ["/".join((*begin, "**"))]

    # Outputs --------------------------------------------------------------------------------------------------------

    def tile(self, z: int, x: int, y: int) -> str:
        """Return the key of a tile."""
        return self._forms["tiles"].make(z=z, x=x, y=y)

    def tiles(self, z: int | None = None, x: int | None = None, y: int | None = None) -> str:
        """Return the key expression of the tiles with those numbers; None is any."""
        return self._forms["tiles"].make(**{n: "*" if v is None else v for n, v in (("z", z), ("x", x), ("y", y))})

    def parse_tile_selector(self, key: str, levels: int | None = None) -> Selected:
        """Return level, x and y of a tile query's key expression, None for ``*``.

        Raises ``QueryFault``: ``bad_key`` for another form or a number that is not canonical, ``bad_level`` for a level
        outside 0 to ``levels`` - 1.
        """
        form = self._forms["tiles"]
        values = form.parse(key)
        if values is None:
            expected = form.make(z="{z}", x="{x}", y="{y}")
            raise QueryFault(QueryCode.BAD_KEY, f"expected {expected}; found {key[:200]!r}")
        numbers: dict[str, int | None] = {}
        for part, text in values.items():
            number = None if text == "*" else canonical_number(text)
            if number is None and text != "*":
                raise QueryFault(
                    QueryCode.BAD_KEY,
                    f"{part}: expected * or an int32 without +, leading zeros or -0; found {text[:80]!r}",
                )
            numbers[part] = number
        z = numbers["z"]
        if z is not None and (z < 0 or (levels is not None and z >= levels)):
            allowed = f"0 to {levels - 1}" if levels is not None else "0 and above"
            raise QueryFault(QueryCode.BAD_LEVEL, f"level: expected {allowed}; found {z}")
        return z, numbers["x"], numbers["y"]

    def update(self, z: int, x: int, y: int) -> str:
        """Return the key on which a changed tile is published."""
        return self._forms["updates"].make(z=z, x=x, y=y)

    def control(self, action: str) -> str:
        """Return the key of an operator's action: ``snapshot``, ``reset`` or ``forget``."""
        return self._forms["control"].make(action=action)

    def alive(self, instance: str) -> str:
        """Return the key of an instance's liveliness token."""
        return self._forms["alive"].make(instance=instance)
