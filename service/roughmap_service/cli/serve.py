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

logger = logging.getLogger(__name__)

SWITCH_SECONDS = 0.0005
"""Python's thread switch interval. At the default of 5 ms an answer waits that long several times while scans are
integrated: p99 is 72 ms under twice the load, and 40 to 58 ms with this value."""


@click.command()
@config_options
@click.option("--fresh", is_flag=True, help="Start a new run. The old store is renamed to map.db.RUN; old logs stay.")
@click.option("--insecure", is_flag=True, help="Allow unencrypted access from the network.")
@click.option("--verbose", is_flag=True, help="Log at debug level.")
def serve(
    config_path: Path | None, settings: tuple[tuple[str, object], ...], fresh: bool, insecure: bool, verbose: bool
) -> None:
    """roughmap serve

    Run the mapping service: receive scans and poses over Zenoh, log them, keep the map and answer queries. When it is
    ready it prints one JSON line on stdout; log lines go to stderr. Ctrl-C or SIGTERM shuts it down in order, a second
    one at once.

    Sensors must be configured: `roughmap config example > roughmap.toml` writes a file to begin with. Without any,
    only clouds in the map's own frame are accepted.
    """
    from roughmap_schemas.config import without_secrets
    from roughmap_service.cli.main import complain
    from roughmap_service.host.log_lines import note, set_up

    sys.setswitchinterval(SWITCH_SECONDS)
    os.umask(os.umask(0o027) | 0o027)  # log and store are readable by owner and group only
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
    text = f"starting roughmap {release}; map {loaded.config.map.name!r}, configuration: {source}"
    note(logger, logging.INFO, "start", text, map=loaded.config.map.name, version=release, configuration=source)

    if not loaded.config.sensors and not any(robot.sensors for robot in loaded.config.robots.values()):
        logger.warning("no sensors configured: only clouds in the map's own frame are accepted; add [sensors.FRAME_ID]")

    # Imported after the signal handlers are set: the import takes a second or more, and process 1 ignores signals that
    # have no handler.
    from roughmap_service.serve import ServiceFailed
    from roughmap_service.serve import serve as run

    def announce(ready: dict[str, Any]) -> None:
        print(json.dumps(ready), flush=True)  # noqa: T201 - the one line that stdout is for
        joined = ", ".join(map(without_secrets, loaded.config.zenoh.connect)) or "nothing"
        where = f"listening on {', '.join(ready['endpoints'])}" if ready["endpoints"] else f"connected to {joined}"
        text = f"ready after {time.monotonic() - begun:.2f} s; {where}; http: {ready['http'] or 'none'}"
        note(logger, logging.INFO, "ready", text, endpoints=ready["endpoints"], http=ready["http"])

    def progress(done: int, files: int) -> None:
        logger.info("rebuilding the map from the log: file %d of %d", done + 1, files)

    code = 0
    try:
        run(loaded, stop, announce, fresh=fresh, insecure=insecure, progress=progress)
        text = f"shut down in order on {reason}, after {time.monotonic() - begun:.0f} s"
        note(logger, logging.INFO, "end", text, signal=reason)
    except ServiceFailed as error:
        code = complain(str(error), 1)
    logging.shutdown()
    os._exit(code)  # not sys.exit: Zenoh's threads may still run, and abort when the interpreter is torn down
