"""Power cuts: a service's journal of what it did to its disk, cut anywhere, with what was not synced lost or torn."""

import random
import shutil
import tomllib
from pathlib import Path

from cut_states import DiskTree, read_journal
from load import SLOW_END_S, Fleet, settings
from processes import Service
from report import Trial
from service_tools import inputs_of, read_back
from shim import Shim

from roughmap_schemas import Config
from roughmap_service.engine.recovery import recover
from roughmap_service.store.map_db import Store

CUTS_OF_ONE = 20
"""Cuts of one run: what its kill left decides what they can find."""


def power_cuts(trial: Trial, folder: Path, rng: random.Random, number: int, *, messages: int = 600) -> None:
    """Recover from ``number`` power cuts, of as many runs as that takes."""
    for run, done in enumerate(range(0, number, CUTS_OF_ONE)):
        _cuts_of_a_run(trial, folder / f"run{run}", rng, min(CUTS_OF_ONE, number - done), messages)
        if trial.found:
            return
        shutil.rmtree(folder / f"run{run}")


def _cuts_of_a_run(trial: Trial, folder: Path, rng: random.Random, number: int, messages: int) -> None:
    """Run a service under load (with a kill and a restart in the midst), and recover from ``number`` cuts of it."""
    shim = Shim(folder, journal=True)
    fleet = Fleet(rng.randrange(1 << 30), clock=lambda: shim.journalled)
    epochs: list[tuple[int, int]] = []
    given = settings(shim.root, log={"max_file_bytes": "256KiB"}, service={"shutdown_timeout": SLOW_END_S})
    for killed in (True, False):
        with Service(folder, environ=shim.environ, **given) as service:
            endpoints = service.ready()["endpoints"]
            epochs.append((shim.journalled, len(epochs) + 1))
            with fleet.at_work(endpoints):
                trial.expect(fleet.wait_promised(fleet.promised + messages // 2, 60.0), "too few receipts")
                if killed:
                    service.process.kill()
                    service.finished()
            if not killed:
                ended = service.stop(seconds=2 * SLOW_END_S)
                trial.expect(ended == 0, f"the end of the run that is cut: {service.err[-3:]}")
    if trial.found:
        return
    whole = [one.payload for one in inputs_of(read_back(shim.root / "log"))]
    config = Config.model_validate(tomllib.loads((folder / "roughmap.toml").read_text()))
    calls = list(read_journal(shim.journal))
    cuts = sorted(rng.randrange(len(calls)) for _ in range(number))
    trial.note("calls in the journal", len(calls))
    disk, done = DiskTree(shim.root), 0
    for cut in cuts:
        for call in calls[done : cut + 1]:
            disk.take(call)
        done = max(done, cut + 1)
        now = calls[cut].end
        left = folder / "left"
        disk.top.write(left, rng)
        epoch = max((e for when, e in epochs if when <= now), default=0)
        recovers(trial, config, left, fleet, whole, now, epoch, f"power cut at call {cut}")
        trial.once()
        shutil.rmtree(left)


def recovers(
    trial: Trial, config: Config, left: Path, fleet: Fleet, whole: list[bytes], now: int, epoch: int, where: str
) -> None:
    """Recover from what a cut left; hold it against the whole run, the promises, and the log alone."""
    log, store = left / "log", Store(left / "store" / "map.db")
    log.mkdir(exist_ok=True)  # as a start does
    try:
        back = recover(config, log, store)
        cut = store.read_cut()
        alone = recover(config, log, None)
    except Exception as error:  # noqa: BLE001 - whatever it is, a start would fail
        trial.expect(False, f"{where}: {type(error).__name__}: {error}")
        return
    digests = back.run.map.digest(), alone.run.map.digest()
    trial.expect(digests[0] == digests[1], f"{where}: the map is {digests[0]}, the log alone makes {digests[1]}")
    trial.expect(back.epoch > epoch, f"{where}: epoch {back.epoch}, and {epoch} was seen already")
    if cut is not None:
        trial.note("with a snapshot")
        trial.expect(cut.record <= alone.run.record, f"{where}: the store is ahead of the log")
    there = [one.payload for one in inputs_of(read_back(log))] if back.run_id else []
    trial.expect(there == whole[: len(there)], f"{where}: the log is not the beginning of what was logged")
    broken = fleet.broken_promises(log, now)
    trial.expect(not broken, f"{where}: {len(broken)} broken promises, the first: {broken[:1]}")
    trial.note("with a torn file", bool(list(log.glob("*.torn"))))
