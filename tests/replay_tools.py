"""`roughmap replay` in this process, and runs to replay."""

import contextlib
import io
from pathlib import Path

from service_tools import LoggedRun

from roughmap import RoughMap
from roughmap_service.cli.main import run as command
from roughmap_service.store.map_db import Store


def replay(*arguments: object) -> tuple[int, str, str]:
    """Run `roughmap replay`; return the exit code, the last line on stdout, and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = command(["replay", *map(str, arguments)])
    said = out.getvalue().strip().splitlines()
    return code, said[-1] if said else "", err.getvalue()


def refused(outcome: tuple[int, str, str], words: str) -> None:
    """Assert exit code 2, nothing on stdout, and ``words`` in the last line on stderr."""
    code, out, err = outcome
    assert (code, out) == (2, "")
    assert words in err.strip().splitlines()[-1]
    assert "Traceback" not in err


def drive(run: LoggedRun, first: int = 0, scans: int = 3) -> None:
    """Put scans into a run, with a checkpoint after each."""
    for k in range(first, first + scans):
        run.scan(float(k), 0.3 * k)
        run.checkpoint()


def three_files(logs: Path) -> LoggedRun:
    """Make a run in three files, two scans in each."""
    with LoggedRun(logs) as run:
        for k in range(3):
            drive(run, 2 * k, 2)
            if k < 2:
                run.rotate()
    return run


def stored(path: Path) -> RoughMap:
    """Return the map of a store."""
    store, rough_map = Store(path), RoughMap()
    cut = store.read_cut()
    assert cut is not None
    store.load_into(rough_map, cut)
    return rough_map
