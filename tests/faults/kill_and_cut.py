"""A kill, a start that goes on from what it left, and then a power cut: nothing may lean on what only a cache held."""

import random
import shutil
import tomllib
from pathlib import Path

from cut_states import OPEN, RENAME, SYNC, UNLINK, Call, DiskTree, read_journal
from load import SLOW_END_S, Fleet, settings, status
from power_cuts import recovers
from processes import Service
from report import Trial
from service_tools import inputs_of, read_back
from shim import Shim

from roughmap_schemas import Config

CUTS = 8
"""Power cuts after one kill."""


def kills_and_cuts(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """Run a service under load once; for each kill, at a call of its journal, start from there and cut its power."""
    shim = Shim(folder, journal=True)
    fleet = Fleet(rng.randrange(1 << 30), clock=lambda: shim.journalled)
    given = settings(shim.root, log=FILES, service={"shutdown_timeout": SLOW_END_S})
    with Service(folder, environ=shim.environ, **given) as service:
        with fleet.at_work(service.ready()["endpoints"]):
            trial.expect(fleet.wait_promised(400, 60.0), "too few receipts")
        ended = service.stop(seconds=2 * SLOW_END_S)
        trial.expect(ended == 0, f"the end of the run that is killed: {service.err[-3:]}")
    calls = list(read_journal(shim.journal))
    kills = [rng.choice(places) for _ in range(-(-number // 3)) for places in _places(calls)]
    for kill in kills[:number]:
        if not trial.found:
            disk = DiskTree(shim.root)
            for call in calls[: kill + 1]:
                disk.take(call)
            _go_on(trial, folder / f"kill{kill}", rng, disk, fleet, calls[kill].end, f"killed at call {kill}")
            trial.once()


FILES = {"max_file_bytes": "64KiB"}
"""So that many footers are written."""


def _places(calls: list[Call]) -> list[list[int]]:
    """Calls behind which a kill may come: any; the last before a footer's sync; a name that may not be synced."""
    logs = {call.handle for call in calls if call.what == OPEN and call.first.endswith(".mcap")}
    last = {call.handle: at for at, call in enumerate(calls) if call.what == SYNC and call.handle in logs}
    named = [at for at, c in enumerate(calls) if c.what in (RENAME, UNLINK) or (c.what == OPEN and c.number)]
    return [list(range(len(calls))), [max(at - 1, 0) for at in last.values()], named]


def _go_on(
    trial: Trial, folder: Path, rng: random.Random, disk: DiskTree, before: Fleet, promised: int, where: str
) -> None:
    """Start from what a kill leaves of the disk, take more in, and recover from power cuts of that."""
    shim = Shim(folder, journal=True)
    disk.top.copy(shim.root)
    disk.root = shim.root
    fleet = Fleet(rng.randrange(1 << 30), clock=lambda: shim.journalled)
    with Service(folder, environ=shim.environ, **settings(shim.root, log=FILES)) as service:
        endpoints = service.ready()["endpoints"]
        ready, epoch = shim.journalled, status(service).epoch
        with fleet.at_work(endpoints):
            trial.expect(fleet.wait_promised(40, 60.0), f"{where}: too few receipts")
            service.kill()
    whole = [one.payload for one in inputs_of(read_back(shim.root / "log"))]
    config = Config.model_validate(tomllib.loads((folder / "roughmap.toml").read_text()))
    calls, done = list(read_journal(shim.journal)), 0
    for cut in sorted(rng.randrange(len(calls)) for _ in range(CUTS)):
        for call in calls[done : cut + 1]:
            disk.take(call)
        done = max(done, cut + 1)
        left, now, place = folder / "left", calls[cut].end, f"{where}, power cut at call {cut}"
        disk.top.write(left, rng)
        recovers(trial, config, left, fleet, whole, now, epoch if now >= ready else 0, place)
        broken = before.broken_promises(left / "log", promised)
        trial.expect(not broken, f"{place}: {len(broken)} promises from before the kill broken, first {broken[:1]}")
        if trial.found:
            return
        shutil.rmtree(left)
    shutil.rmtree(folder)
