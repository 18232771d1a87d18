"""`roughmap serve`."""

import json
import logging
import os
import signal
import sys
import threading
import time
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any

import click

from roughmap_service.cli.options import config_options, load

log = logging.getLogger(__name__)

SWITCH_SECONDS = 0.0005
"""How long a thread may keep Python from the others: at the default of 5 ms an answer waits that long several times
while scans come in (p99 under twice the load 72 ms, at this 40 to 58)."""


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
    from roughmap_schemas.config import without_secrets
    from roughmap_service.cli.main import complain
    from roughmap_service.host.log_lines import note, set_up

    sys.setswitchinterval(SWITCH_SECONDS)
    os.umask(os.umask(0o027) | 0o027)  # log and store may be read by the group, and by nobody else
    loaded = load(config_path, settings)
    service = loaded.config.service
    set_up(service.log_format, "debug" if verbose else service.log_level, sys.stderr)
    begun = time.monotonic()

    stop = threading.Event()
    reason = ""

    def end(number: int, _frame: FrameType | None) -> None:
        nonlocal reason
        if stop.is_set():
            os._exit(1)
        reason = signal.Signals(number).name
        stop.set()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)

    source, release = str(loaded.path or "no file"), version("roughmap")
    text = f"roughmap {release} starts; map {loaded.config.map.name!r}, configuration: {source}"
    note(log, logging.INFO, "start", text, map=loaded.config.map.name, version=release, configuration=source)

    if not loaded.config.sensors and not any(robot.sensors for robot in loaded.config.robots.values()):
        log.warning("no sensors: only clouds in the map's own frame are taken; add [sensors.FRAME_ID]")

    # Loaded when signals are heeded already: it takes a second and more, and a process 1 would never hear of one.
    from roughmap_service.serve import ServiceFailed
    from roughmap_service.serve import serve as run

    def announce(ready: dict[str, Any]) -> None:
        print(json.dumps(ready), flush=True)  # noqa: T201 - the one line that stdout is for
        joined = ", ".join(map(without_secrets, loaded.config.zenoh.connect)) or "nobody"
        where = f"listens on {', '.join(ready['endpoints'])}" if ready["endpoints"] else f"joins {joined}"
        text = f"ready after {time.monotonic() - begun:.2f} s; {where}; http: {ready['http'] or 'none'}"
        note(log, logging.INFO, "ready", text, endpoints=ready["endpoints"], http=ready["http"])

    def progress(done: int, files: int) -> None:
        log.info("folding the log: file %d of %d", done + 1, files)

    code = 0
    try:
        run(loaded, stop, announce, fresh=fresh, insecure=insecure, progress=progress)
        text = f"ended in order on {reason}, after {time.monotonic() - begun:.0f} s"
        note(log, logging.INFO, "end", text, signal=reason)
    except ServiceFailed as error:
        code = complain(str(error), 1)
    logging.shutdown()
    os._exit(code)  # a thread that Zenoh lets go of only now would find the interpreter half gone, and abort
