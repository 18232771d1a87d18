"""Options that several commands share, and the settings they give."""

import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from roughmap_schemas.config_load import LoadedConfig, load_config
from roughmap_schemas.sections import ENDPOINT_PATTERN

F = TypeVar("F", bound=Callable[..., Any])


class Failure(click.ClickException):
    """The command was asked for rightly, but could not be done: one line, exit 1."""

    exit_code = 1


class BadUse(click.ClickException):
    """What was asked for can't be: one line, exit 2."""

    exit_code = 2


def setting(text: str) -> tuple[str, object]:
    """`KEY=VALUE` with a dotted key; the value is JSON where it parses as that, else a text."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise click.BadParameter(f"{text!r}: expected KEY=VALUE, such as map.cell_size=0.2")
    try:
        return key.strip(), json.loads(value)
    except ValueError:
        return key.strip(), value


def bounding_box(text: str) -> tuple[float, float, float, float]:
    """`xmin,ymin,xmax,ymax` in metres."""
    try:
        xmin, ymin, xmax, ymax = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r}: expected four numbers, xmin,ymin,xmax,ymax in metres") from None
    if not (xmin < xmax and ymin < ymax and xmax - xmin < float("inf") and ymax - ymin < float("inf")):
        raise click.BadParameter(f"{text!r}: expected finite numbers with xmin < xmax and ymin < ymax")
    return xmin, ymin, xmax, ymax


def config_options(function: F) -> F:
    """`-c FILE` as `config_path` and `--set KEY=VALUE` as `settings`; read both with `load`."""
    for option in (
        click.option(
            "--set",
            "settings",
            type=setting,
            multiple=True,
            metavar="KEY=VALUE",
            help="A setting over file and environment, such as map.cell_size=0.2.",
        ),
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


def endpoint(text: str) -> str:
    """A Zenoh endpoint, `PROTOCOL/ADDRESS`."""
    if not re.match(ENDPOINT_PATTERN, text):
        raise click.BadParameter(f"{text!r}: expected PROTOCOL/ADDRESS, such as tcp/127.0.0.1:7447")
    return text


connect_option = click.option(
    "--connect",
    type=endpoint,
    multiple=True,
    metavar="ENDPOINT",
    help="Zenoh endpoint of the service or router, such as tcp/127.0.0.1:7447; may be given several times.",
)

zenoh_option = click.option(
    "--zenoh",
    "zenoh_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Zenoh configuration (JSON5) of this session: certificates, password, endpoints; in place of [zenoh].",
)


def reachable(address: str) -> str:
    """An address to connect to, where the given one listens on: all addresses of this machine hold loopback's."""
    return address.replace("0.0.0.0:", "127.0.0.1:").replace("[::]:", "[::1]:")


def load(config_path: Path | None, settings: tuple[tuple[str, object], ...]) -> LoadedConfig:
    """The configuration: file, then environment, then `--set`. Raises ConfigFault in one line (exit 2)."""
    environ: Mapping[str, str] = os.environ
    return load_config(config_path, dict(settings), environ)
