"""Reads the configuration: file, then environment, then command line; later values replace earlier ones.

An error is one line: the source of the value, its key, and what is allowed.
"""

import difflib
import json
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from roughmap_schemas.config import REMOVED, Config, without_secrets
from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.keys import NAME_PATTERN, NAME_WORDS, TEMPLATES
from roughmap_schemas.layers import default_limits
from roughmap_schemas.robot_sections import mounted_twice
from roughmap_schemas.values import LEAST

DEFAULT_FILE: Final = Path("roughmap.toml")
PREFIX: Final = "ROUGHMAP_"
MAX_FILE: Final = 1 << 20
"""Largest configuration file in bytes; anything larger is some other file."""

FILES_ONLY: Final = ("sensors", "robots")
"""Tables whose keys are names of frames and robots, which environment variables can't express."""

TABLES: Final = (("map", "limits"), ("map", "keep"))
"""Tables within a section whose values can be set one by one."""

DEFAULT: Final = "default"

T = TypeVar("T")

SECRETS: Final = ("zenoh.password", "http.token")
"""Settings read from the environment only: command lines are visible to other users, and files get shared."""


@dataclass(frozen=True)
class LoadedConfig:
    """The effective settings and where each comes from.

    ``sources`` maps dotted keys (``map.cell_size``, ``sensors.lidar.range_sigma``) to "default", "file NAME",
    "environment NAME" or "command line". ``path`` is the file that was read, or None.
    """

    config: Config
    sources: dict[str, str]
    path: Path | None

    def given(self, dotted: str) -> bool:
        """Return whether a setting was given anywhere."""
        return self.sources.get(dotted, DEFAULT) != DEFAULT


def load_config(
    path: Path | None = None, overrides: Mapping[str, object] | None = None, environ: Mapping[str, str] | None = None
) -> LoadedConfig:
    """Read the settings; raises ``ConfigFault``.

    Without ``path``, ./roughmap.toml is read if it exists. ``overrides`` are dotted keys from the command line,
    ``environ`` the environment variables.
    """
    values: dict[str, Any] = {}
    given: dict[str, str] = {}
    file = path if path is not None else (DEFAULT_FILE if DEFAULT_FILE.is_file() else None)
    if file is not None:
        values = read_toml(file)
        given.update(dict.fromkeys(_leaves(values), f"file {file}"))
    variables = sorted((name, text) for name, text in (environ or {}).items() if name.startswith(PREFIX))
    for parts, (name, text) in _in_turn(
        (name[len(PREFIX) :].lower().split("__"), (name, text)) for name, text in variables
    ):
        source = f"environment {name}"
        _put(values, given, parts, _from_text(parts, text, source), source)
    for parts, value in _in_turn((dotted.split("."), value) for dotted, value in (overrides or {}).items()):
        _put(values, given, parts, value, "command line")
    for dotted in SECRETS:
        if not given.get(dotted, "environment").startswith("environment"):
            variable = PREFIX + dotted.upper().replace(".", "__")
            raise ConfigFault(
                f"{given[dotted]}: {dotted}: must be set by {dotted}_file or the environment variable {variable}"
            )
    config = _validated(values, given, str(file) if file is not None else "configuration")
    if fault := mounted_twice(values):
        raise ConfigFault(f"{file}: {fault}")
    sources = {dotted: given.get(dotted, DEFAULT) for dotted in _leaves(config.model_dump(mode="python"))}
    for dotted in sources:
        # A robot's sensor takes settings that it does not have from the general table of that frame.
        if dotted.startswith("robots.") and dotted not in given:
            sources[dotted] = given.get(f"sensors.{dotted.partition('.sensors.')[2]}", DEFAULT)
    return LoadedConfig(config, sources, file)


def config_from(values: Mapping[str, Any], source: str) -> Config:
    """Return the settings from a dict in the form of ``Config.public_dict``; errors name ``source``."""
    return _validated(dict(values), {}, source)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raises ``ConfigFault``, which names the file and, for invalid TOML, the line."""
    try:
        if path.stat().st_size > MAX_FILE:
            raise ConfigFault(f"{path}: expected at most {MAX_FILE} bytes of TOML; found {path.stat().st_size}")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigFault(f"{path}: can't be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise ConfigFault(f"{path}: not UTF-8 text (byte {error.start})") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigFault(f"{path}: invalid TOML: {error}") from None
    except RecursionError:
        raise ConfigFault(f"{path}: nested too deep") from None


def _leaves(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the dotted keys: to a depth of three, more under robots; anything deeper is one value."""
    for section, table in values.items():
        if isinstance(table, dict):
            yield from _deep(section, table, 3 if section == "robots" else 1)
        else:
            yield section


def _deep(prefix: str, table: Mapping[str, Any], depth: int) -> Iterator[str]:
    for key, value in table.items():
        dotted = f"{prefix}.{key}"
        if depth and isinstance(value, dict) and value:
            yield from _deep(dotted, value, depth - 1)
        else:
            yield dotted


def _put(values: dict[str, Any], given: dict[str, str], parts: tuple[str, ...], value: object, source: str) -> None:
    """Set one value, replacing an earlier one; raises ``ConfigFault`` for an unknown key."""
    dotted = ".".join(parts)
    if dotted in REMOVED:
        raise ConfigFault(f"{source}: {dotted}: {_removed(dotted)}")
    if parts[0] in FILES_ONLY:
        raise ConfigFault(f"{source}: {dotted}: {parts[0]} can only be set in a file, as [{parts[0]}.NAME] tables")
    section = _section(parts[0])
    if section is None or len(parts) < 2:
        meant = _meant(parts[0], _sections())
        raise ConfigFault(
            f"{source}: {dotted}: unknown key{meant} (allowed: SECTION.KEY with {', '.join(_sections())})"
        )
    allowed = tuple(TEMPLATES) if parts[0] == "keys" else tuple(section.model_fields)
    if parts[1] not in allowed or len(parts) > (3 if parts[:2] in TABLES else 2):
        meant = _meant(parts[1], allowed)
        raise ConfigFault(f"{source}: {dotted}: unknown key{meant} (allowed in {parts[0]}: {', '.join(allowed)})")
    table = values.setdefault(parts[0], {})
    if not isinstance(table, dict):
        raise ConfigFault(f"{given.get(parts[0], 'configuration')}: {parts[0]}: must be a table")
    if len(parts) == 3:
        present = table.get(parts[1], _defaults(parts[1], table))
        value = {**(present if isinstance(present, dict) else {}), parts[2]: value}
    table[parts[1]] = value
    given[".".join(parts[:2])] = given[dotted] = source
    if len(parts) == 2 and isinstance(value, dict):
        given.update(dict.fromkeys(_deep(dotted, value, 0), source))


def _in_turn(items: Iterable[tuple[Sequence[str], T]]) -> list[tuple[tuple[str, ...], T]]:
    """Return keys and values in the order in which they are put: `map.surface` before limits that depend on it."""
    given = [(tuple(parts), value) for parts, value in items]
    return sorted(given, key=lambda item: item[0] != ("map", "surface"))


def _defaults(name: str, table: Mapping[str, Any]) -> Mapping[str, object]:
    """Return the values that a table within [map] has beside the one that is given."""
    return default_limits(table.get("surface")) if name == "limits" else {}


def _sections() -> list[str]:
    return [name for name in Config.model_fields if name not in FILES_ONLY]


def _section(name: str) -> type[BaseModel] | None:
    """Return a section's model; for ``keys``, which is a plain table, that of the whole configuration."""
    if name == "keys":
        return Config
    field = Config.model_fields.get(name)
    annotation = field.annotation if field is not None else None
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _from_text(parts: tuple[str, ...], text: str, source: str) -> object:
    """Read a variable's value: lists and tables as JSON, anything else as text."""
    if ".".join(parts) in SECRETS or not text.lstrip().startswith(("[", "{")):
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise ConfigFault(f"{source}: {'.'.join(parts)}: must be JSON; found {_found(text, parts)}") from None


def _validated(values: dict[str, Any], given: Mapping[str, str], otherwise: str) -> Config:
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise ConfigFault(_line(error, given, otherwise)) from None


def _line(error: ValidationError, given: Mapping[str, str], otherwise: str) -> str:
    """Return the first error in one line. An unknown key comes first: it may be the misspelling of a missing one."""
    errors = error.errors(include_url=False, include_context=False)
    first = min(errors, key=lambda fault: fault["type"] != "extra_forbidden")
    parts = tuple(str(part) for part in first["loc"] if part != "[key]")
    dotted = ".".join(parts)
    text = first["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    text = text.replace(f"{LEAST:.30f}", f"{LEAST:g}")  # pydantic writes out all 30 digits
    if dotted in REMOVED:
        text = _removed(dotted)
    elif first["type"] == "extra_forbidden":
        allowed = _allowed(parts[:-1])
        text = f"unknown key{_meant(parts[-1], allowed)} (allowed: {', '.join(allowed)})"
    elif first["type"] == "missing" and isinstance(first["loc"][-1], int):
        short = [fault for fault in errors if fault["type"] == "missing" and fault["loc"][:-1] == first["loc"][:-1]]
        dotted = ".".join(parts[:-1])
        text = f"expected {first['loc'][-1] + len(short)} values, found {first['loc'][-1]}"
        errors = errors[len(short) - 1 :]
    elif first["type"] == "missing":
        text = "is required"
    elif first["type"] == "string_pattern_mismatch":
        pattern = text.partition(" pattern ")[2]
        must = f"must be {NAME_WORDS}" if NAME_PATTERN.removesuffix(r"\Z") in pattern else f"must match {pattern}"
        text = f"{must}; found {_found(first['input'], parts)}"
    elif first["type"] in ("model_type", "dict_type"):
        how = f" (its values one by one, as {dotted}.NAME=VALUE)" if isinstance(first["input"], str) else ""
        text = f"must be a table{how}; found {_found(first['input'], parts)}"
    elif dotted and not text.startswith(f"{dotted}.") and "found" not in text:
        text = f"{text}; found {_found(first['input'], parts)}"
    key, colon, rest = text.partition(": ")
    if colon and " " not in key and (not dotted or key.startswith(f"{dotted}.")):
        # A check across several settings names its setting itself.
        dotted, text = key, rest
    source = next((given[known] for known in _prefixes(dotted) if known in given), otherwise)
    more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
    return f"{source.removeprefix('file ')}: {dotted}: {text}{more}".replace("\n", " ")


def _removed(dotted: str) -> str:
    """Return what to do about a setting that no longer exists."""
    return f"is no longer a setting (always {REMOVED[dotted]}): remove it"


def _meant(key: str, allowed: Sequence[str]) -> str:
    """Return a hint at the key that was probably meant, or ""."""
    close = difflib.get_close_matches(key, allowed, 1)
    return f", did you mean {close[0]}?" if close else ""


def _prefixes(dotted: str) -> Iterator[str]:
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        yield ".".join(parts[:length])


def _allowed(parts: tuple[str, ...]) -> tuple[str, ...]:
    """Return the allowed keys of the table at ``parts``."""
    model: type[BaseModel] = Config
    names = list(parts)
    while names:
        name = names.pop(0)
        field = model.model_fields.get(name)
        if field is None:
            continue  # a frame's or a robot's name
        inner = field.annotation
        arguments: tuple[Any, ...] = getattr(inner, "__args__", ())
        inner = arguments[1] if len(arguments) == 2 else inner
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            model = inner
    return tuple(model.model_fields)


def _found(value: object, parts: tuple[str, ...]) -> str:
    """Return a value as errors show it. Of ``zenoh`` and ``http`` nothing secret is shown: only the address of an
    endpoint, and only the type of a value that should be a table or a single text."""
    if parts[:1] in {("zenoh",), ("http",)} and not isinstance(value, bool | int | float):
        value = without_secrets(value) if isinstance(value, str) and len(parts) > 1 else type(value)
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
