"""Options that several commands share, and the settings that they give."""

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from roughmap_schemas.config_load import LoadedConfig, load_config
from roughmap_schemas.sections import ENDPOINT_PATTERN

F = TypeVar("F", bound=Callable[..., Any])


class Failure(click.ClickException):
    """The command failed: one line, exit code 1."""

    exit_code = 1


class BadUse(click.ClickException):
    """The command was used wrongly: one line, exit code 2."""

    exit_code = 2


def setting(text: str) -> tuple[str, object]:
    """Parse `KEY=VALUE` with a dotted key; a value that is not JSON is a string."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise click.BadParameter(f"{text!r}: expected KEY=VALUE, for example map.cell_size=0.2")
    try:
        return key.strip(), json.loads(value)
    except ValueError:
        return key.strip(), value


def bounding_box(text: str) -> tuple[float, float, float, float]:
    """Parse `xmin,ymin,xmax,ymax` in metres."""
    try:
        xmin, ymin, xmax, ymax = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r}: expected four numbers, xmin,ymin,xmax,ymax in metres") from None
    if not (xmin < xmax and ymin < ymax and xmax - xmin < float("inf") and ymax - ymin < float("inf")):
        raise click.BadParameter(f"{text!r}: expected finite numbers with xmin < xmax and ymin < ymax")
    return xmin, ymin, xmax, ymax


def config_options(function: F) -> F:
    """Add `-c FILE` as `config_path` and `--set KEY=VALUE` as `settings`, the arguments of `load`."""
    for option in (
        click.option(
            "--set",
            "settings",
            type=setting,
            multiple=True,
            metavar="KEY=VALUE",
            help="Override a setting, for example map.cell_size=0.2. Can be repeated.",
        ),
        click.option(
            "-c",
            "--config",
            "config_path",
            type=click.Path(path_type=Path, dir_okay=False),
            help="Configuration file. [default: ./roughmap.toml, if it exists]",
        ),
    ):
        function = option(function)
    return function


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def endpoint(text: str) -> str:
    """Check a Zenoh endpoint, `PROTOCOL/ADDRESS`."""
    if not re.match(ENDPOINT_PATTERN, text):
        raise click.BadParameter(f"{text!r}: expected PROTOCOL/ADDRESS, for example tcp/127.0.0.1:7447")
    return text


connect_option = click.option(
    "--connect",
    type=endpoint,
    multiple=True,
    metavar="ENDPOINT",
    help="Zenoh endpoint of the service or router, for example tcp/127.0.0.1:7447. Can be repeated.",
)

zenoh_option = click.option(
    "--zenoh",
    "zenoh_file",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="Zenoh configuration file (JSON5) for this command's session, used instead of the [zenoh] settings.",
)


def reachable(address: str) -> str:
    """Return the address to connect to for an address to listen on: loopback, where that is all interfaces."""
    return address.replace("0.0.0.0:", "127.0.0.1:").replace("[::]:", "[::1]:")


def load(config_path: Path | None, settings: tuple[tuple[str, object], ...]) -> LoadedConfig:
    """Load the configuration: file, then environment, then `--set`. Raises ConfigFault."""
    return load_config(config_path, dict(settings), os.environ)
