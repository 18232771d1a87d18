"""`roughmap serve`."""

import json
import logging
import os
import signal
import sys
import threading
from pathlib import Path
from types import FrameType
from typing import Any

import click

from .options import config_options, load


@click.command()
@config_options
@click.option("--fresh", is_flag=True, help="Begin a new run; the store is renamed to map.db.RUN, old logs stay.")
@click.option("--insecure", is_flag=True, help="Allow whoever is on the network to connect: no TLS beyond loopback.")
@click.option("--verbose", is_flag=True, help="Tell more on stderr.")
def serve(
    config_path: Path | None, settings: tuple[tuple[str, object], ...], fresh: bool, insecure: bool, verbose: bool
) -> None:
    """roughmap serve -c roughmap.toml

    Keep one map: take scans and poses from Zenoh, log them, answer planners' queries. Prints one JSON line on stdout
    when it is ready; everything else goes to stderr. SIGTERM or Ctrl-C ends it in order, a second one at once.
    """
    from roughmap_service.serve import serve as run

    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(asctime)s %(levelname)s %(message)s",
        stream=sys.stderr,
    )
    stop = threading.Event()

    def end(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            os._exit(1)
        stop.set()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)

    def announce(ready: dict[str, Any]) -> None:
        print(json.dumps(ready), flush=True)  # noqa: T201 - the one line that stdout is for

    def progress(done: int, files: int) -> None:
        click.echo(f"folding the log: file {done + 1} of {files}", err=True)

    run(load(config_path, settings), stop, announce, fresh=fresh, insecure=insecure, progress=progress)
