"""SIGKILL under load, in start-up and in shutdown: what was acknowledged is there once, and the map is its replay."""

import random
import re
import shutil
import signal
import subprocess
import threading
import time
from pathlib import Path

from load import Fleet, settings
from processes import COMMAND, STOP_S, Service, environment
from report import Trial

from roughmap_service.journal.run_files import find_files, one_run

CHAIN = 5
"""Kills of one run, each after a restart from what the last one left; then the run ends in order."""


def kills(trial: Trial, folder: Path, rng: random.Random, number: int, *, longest: float = 2.0) -> None:
    """Kill a service under load at random instants, and start it again."""
    while trial.tried < number:
        _chain(
            trial, folder / f"kills-{trial.tried}", rng, min(CHAIN, number - trial.tried), longest, in_shutdown=False
        )


def kills_in_shutdown(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """The same, a random instant after a SIGTERM under load."""
    while trial.tried < number:
        _chain(trial, folder / f"ends-{trial.tried}", rng, min(CHAIN, number - trial.tried), 1.0, in_shutdown=True)


def _chain(trial: Trial, folder: Path, rng: random.Random, number: int, longest: float, *, in_shutdown: bool) -> None:
    fleet, run = Fleet(rng.randrange(1 << 30)), Run(trial, folder)
    for _ in range(number):
        with Service(folder, **settings(folder)) as service:
            endpoints = service.ready()["endpoints"]
            run.started()
            with fleet.at_work(endpoints):
                fleet.wait_promised(fleet.promised + 1)
                _wait(rng.uniform(0.0, longest))
                if in_shutdown:
                    service.process.send_signal(signal.SIGTERM)
                    _wait(rng.uniform(0.0, 0.6))
                service.process.kill()
                code = service.finished()
        trial.note("ended before the kill", code == 0)
        run.stopped(fleet)
        trial.once()
    run.ends_in_order(fleet)
    trial.note("receipts", fleet.promised)
    trial.note("queries", fleet.answers)
    shutil.rmtree(folder)


def kills_in_start(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """Kill a service on its way up, over and over, on a log and store that a kill left under load."""
    fleet, run = Fleet(rng.randrange(1 << 30)), Run(trial, folder)
    begun = time.monotonic()
    with Service(folder, **settings(folder)) as service:
        endpoints = service.ready()["endpoints"]
        took = time.monotonic() - begun
        with fleet.at_work(endpoints):
            fleet.wait_promised(150)
            service.process.kill()
            service.finished()
    for left in reversed(range(number)):
        with Service(folder, **settings(folder)) as service:
            _wait(rng.uniform(0.3, 1.2) * took)  # before that it only loads its libraries
            service.process.kill()
            service.finished()
            trial.note("were ready by then", bool(service.out))
        run.stopped(fleet, compare=not left)
        trial.once()
    run.ends_in_order(fleet)


class Run:
    """Watches one run over its starts: epochs rise, promises are kept, the map is what the log makes."""

    def __init__(self, trial: Trial, folder: Path) -> None:
        self.trial = trial
        self.folder = folder
        self.log = folder / "log"
        self.epoch = 0
        self._replay: subprocess.Popen[str] | None = None

    def started(self) -> None:
        """The service is ready: what it took up is what the replay of the surviving log makes."""
        last = one_run(find_files([self.log]))[-1].metadata
        self.trial.expect(last.epoch > self.epoch, f"epoch {last.epoch} after {self.epoch}")
        self.epoch = last.epoch
        if self._replay is None:
            return
        said, complained = self._replay.communicate(timeout=STOP_S * 3)
        verdict = (said.strip() or complained.strip()).splitlines()[-1]
        self._replay = None
        found = re.fullmatch(r"equal: \d+ checkpoints, sequence (\d+), digest ([0-9a-f]{32})", verdict)
        if found is None:
            self.trial.expect("no checkpoint" in verdict, f"replay of the surviving log: {verdict}")
            return
        self.trial.note("compared with a replay")
        here = last.base_sequence, last.base_digest
        self.trial.expect(here == (int(found[1]), found[2]), f"the map is {here}, the replay says {verdict}")

    def stopped(self, fleet: Fleet, *, compare: bool = True) -> None:
        """The service is dead: hold its log against what was promised, and begin to replay a copy of it."""
        for broken in fleet.broken_promises(self.log):
            self.trial.expect(False, broken)
        for broken in fleet.invented(self.log):
            self.trial.expect(False, broken)
        if not compare:
            return
        copy = self.folder / "surviving"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(self.log, copy, ignore=shutil.ignore_patterns(".lock", "*.part"))
        self._replay = subprocess.Popen(
            [*COMMAND, "replay", str(copy)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )

    def ends_in_order(self, fleet: Fleet) -> None:
        """One more start: all that was ever handed in is acknowledged, and the whole log replays."""
        with Service(self.folder, **settings(self.folder)) as service:
            endpoints = service.ready()["endpoints"]
            self.started()
            with fleet.at_work(endpoints, most=10) as done:
                self.trial.expect(done.wait(60.0), f"not acknowledged: {fleet.left()}")
            self.trial.expect(service.stop() == 0, f"the end: {service.err[-3:]}")
        self.stopped(fleet)
        assert self._replay is not None
        said, complained = self._replay.communicate(timeout=STOP_S * 6)
        self.trial.expect(said.startswith("equal: "), f"replay of the whole log: {said} {complained[-300:]}")
        self._replay = None


def _wait(seconds: float) -> None:
    """The instant of a kill is random: there is nothing to wait for."""
    threading.Event().wait(seconds)
