"""Options that several commands share, and the settings they give."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from roughmap_schemas.config_load import LoadedConfig, load_config

F = TypeVar("F", bound=Callable[..., Any])


class Failure(click.ClickException):
    """The command was asked for rightly, but could not be done: one line, exit 1."""

    exit_code = 1


class BadUse(click.ClickException):
    """What was asked for can't be: one line, exit 2."""

    exit_code = 2


class Setting(click.ParamType):
    """`KEY=VALUE` with a dotted key; the value is JSON where it parses as that, else a text."""

    name = "KEY=VALUE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, object]:
        if isinstance(value, tuple):
            return value
        key, equals, text = str(value).partition("=")
        if not equals or not key.strip():
            self.fail(f"{value!r}: expected KEY=VALUE, such as map.cell_size=0.2", param, ctx)
        try:
            return key.strip(), json.loads(text)
        except ValueError:
            return key.strip(), text


class Numbers(click.ParamType):
    """A fixed count of finite numbers, separated by commas."""

    def __init__(self, *parts: str) -> None:
        self.parts = parts
        self.name = ",".join(parts)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(part) for part in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != len(self.parts) or not all(abs(number) < float("inf") for number in numbers):
            self.fail(f"{value!r}: expected {len(self.parts)} numbers, {self.name}", param, ctx)
        return numbers


def config_options(function: F) -> F:
    """`-c FILE` as `config_path` and `--set KEY=VALUE` as `settings`; read both with `load`."""
    for option in (
        click.option("--set", "settings", type=Setting(), multiple=True, help="A setting over file and environment."),
        click.option(
            "-c",
            "--config",
            "config_path",
            type=click.Path(path_type=Path, dir_okay=False),
            help="Configuration file; without it ./roughmap.toml, if there is one.",
        ),
    ):
        function = option(function)
    return function


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, for another program.")

connect_option = click.option(
    "--connect",
    multiple=True,
    metavar="ENDPOINT",
    help="Zenoh endpoint of the service or router, such as tcp/127.0.0.1:7447; may be given several times.",
)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
"""Where `serve` listens unless told otherwise, so that the commands find it without an option."""


def load(config_path: Path | None, settings: tuple[tuple[str, object], ...]) -> LoadedConfig:
    """The configuration: file, then environment, then `--set`. Raises ConfigFault in one line (exit 2)."""
    environ: Mapping[str, str] = os.environ
    return load_config(config_path, dict(settings), environ)
