"""A store that is gone, old, or newer than the log: the map is that of the log, or a start says what is missing."""

import logging
import random
import shutil
from pathlib import Path

from report import Trial
from service_tools import LoggedRun, config

from roughmap_service.engine.recovery import recover
from roughmap_service.journal.reader import LogError
from roughmap_service.journal.run_files import find_files
from roughmap_service.store.map_db import Store


def odd_stores(trial: Trial, folder: Path, rng: random.Random, number: int) -> None:
    """One run of many files and snapshots; ``number`` times some of its files beside some of its snapshots."""
    logging.disable(logging.ERROR)
    store = Store(folder / "map.db")
    snapshots: list[Path] = []
    digests: list[str] = []
    with LoggedRun(folder / "log", store=store) as run:
        for n in range(8):
            for k in range(3):
                run.scan(3.0 * n + k, 0.3 * (3 * n + k))
                if rng.random() < 0.4:
                    run.snapshot()
                    snapshots.append(Path(shutil.copyfile(store.path, folder / f"map-{len(snapshots)}.db")))
            digests.append(run.run.map.digest())
            if n < 7:
                run.rotate()
    files = sorted((folder / "log").glob("*.mcap"))
    cuts = {path: Store(path).read_cut() for path in snapshots}
    begins = [file.metadata.first_record for file in find_files(files)]
    for _ in range(number):
        work = folder / "work"
        shutil.rmtree(work, ignore_errors=True)
        (work / "log").mkdir(parents=True)
        first = rng.choice((0, 0, rng.randrange(8)))
        last = rng.choice((7, rng.randrange(first, 8)))
        for file in files[first : last + 1]:
            shutil.copyfile(file, work / "log" / file.name)
        chosen = rng.choice([None, *snapshots])
        there = Store(work / "map.db")
        cut = None
        if chosen is not None:
            shutil.copyfile(chosen, there.path)
            cut = cuts[chosen]
        end = begins[last + 1] - 1 if last < 7 else 10**9
        newer = cut is not None and cut.record > end
        begun = 1 if cut is None or newer else cut.record + 1
        possible = begins[first] <= begun
        where = f"files {first} to {last}, store at {None if cut is None else cut.record}"
        try:
            back = recover(config(), work / "log", there)
            trial.expect(possible, f"{where}: taken up, though something is missing")
            trial.expect(back.run.map.digest() == digests[last], f"{where}: another map")
            trial.note("newer than the log" if newer else "gone" if cut is None else "as old as it may be")
        except LogError as error:
            trial.expect(not possible, f"{where}: {error}")
            trial.expect(files[first].name in str(error), f"{where}: not named: {error}")
            trial.note("refused by name")
        trial.once()
    logging.disable(logging.NOTSET)
