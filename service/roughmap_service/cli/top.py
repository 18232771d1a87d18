"""`roughmap top`: watch a running service in the terminal."""

import contextlib
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roughmap_service.cli.options import Failure, config_options, connect_option, json_option, load, zenoh_option

if TYPE_CHECKING:
    from roughmap_client import RoughMapClient
    from roughmap_service.cli.top_frame import Robots

PERIOD_S = 1.0
"""The service renews its status once a second."""


@click.command
@click.option("--map", "map_name", help="Name of the map. [default: map.name of the configuration]")
@connect_option
@zenoh_option
@click.option(
    "--timeout",
    type=click.FloatRange(0.1, 3600),
    default=5.0,
    show_default=True,
    help="How long to wait for the service, in seconds.",
)
@click.option("--once", is_flag=True, help="Print once and exit.")
@config_options
@json_option
def top(
    map_name: str | None,
    connect: tuple[str, ...],
    zenoh_file: Path | None,
    timeout: float,
    once: bool,
    config_path: Path | None,
    settings: tuple[tuple[str, object], ...],
    as_json: bool,
) -> None:
    """roughmap top

    Watch a running service until Ctrl-C: rates, lag, rejections with their reasons, robots, memory, tiles and log,
    once a second. The robots are those whose clouds were decided since top started. With --json, print the status as
    one line each second.
    """
    from roughmap_client import NoAnswer, RoughMapClient
    from roughmap_schemas.keys import Keys
    from roughmap_service.cli.connection import client_config, if_guarded, open_client
    from roughmap_service.cli.top_frame import Robots

    loaded = load(config_path, settings)
    config = loaded.config
    name = map_name or config.map.name
    robots = Robots()
    zenoh_config = client_config(loaded, connect, zenoh_file)
    with open_client(zenoh_config, timeout) as session:
        session.declare_subscriber(
            Keys(name, config.keys).events, lambda sample: robots.take(sample.payload.to_bytes())
        )
        client = RoughMapClient(name, session=session, timeout=timeout, keys=config.keys)
        try:
            client.status()
            with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C is how top ends
                _watch(client, robots, once=once, as_json=as_json)
        except NoAnswer as error:
            hint = f"is the map {name!r} served there? (--connect, --map){if_guarded(zenoh_config)}"
            raise Failure(f"{error}; {hint}") from error


def _watch(client: "RoughMapClient", robots: "Robots", *, once: bool, as_json: bool) -> None:
    from rich.console import Console
    from rich.live import Live

    from roughmap_client import NoAnswer
    from roughmap_schemas.messages import model_bytes
    from roughmap_service.cli.top_frame import frame

    console, pause = Console(highlight=False), threading.Event()
    once = once or not (as_json or console.is_terminal)  # in a pipe, print once
    pause.wait(PERIOD_S)  # so that events of the robots arrive
    if as_json or once:
        while True:
            status = client.status()
            if as_json:
                click.echo(model_bytes(status).decode())
            else:
                console.print(frame(status, robots.rows(), 0.0))
            if once or pause.wait(PERIOD_S):
                return
    status, seen = client.status(), time.monotonic()
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while True:
            with contextlib.suppress(NoAnswer):  # the frame shows for how long there was no answer
                status, seen = client.status(timeout=PERIOD_S), time.monotonic()
            live.update(frame(status, robots.rows(), time.monotonic() - seen), refresh=True)
            pause.wait(PERIOD_S)
