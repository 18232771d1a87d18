"""make faults

Does to a service what it must survive, says what was tried how often, and exits 1 if anything was found.
"""

import argparse
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

import paths  # noqa: F401 - before what it makes importable
from report import Trial, table
from trials import TRIALS

MEMORY = Path("/dev/shm")
NO_DISK = {"cuts", "logflips", "storeflips", "stores"}
"""Trials of what is read, not of what is on the disk: syncing their thousands of files would take most of the time."""


def main() -> int:
    """Parse, try, tell."""
    parser = argparse.ArgumentParser(prog="make faults", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=TRIALS, metavar="NAME", help=f"of {', '.join(TRIALS)}")
    parser.add_argument("--share", type=float, default=1.0, help="how much of the full numbers, such as 0.1")
    parser.add_argument("--seed", type=int, default=None, help="what all chances come from; printed if not given")
    asked = parser.parse_args()
    seed = random.SystemRandom().randrange(1 << 32) if asked.seed is None else asked.seed
    print(f"seed {seed}: again with ARGS='--seed {seed}'", file=sys.stderr)
    trials = []
    base = Path(tempfile.mkdtemp(prefix="roughmap-faults-"))
    quick = Path(tempfile.mkdtemp(prefix="roughmap-faults-", dir=MEMORY if MEMORY.is_dir() else None))
    for name in asked.only or TRIALS:
        title, do, full = TRIALS[name]
        number = max(round(full * asked.share), 1)
        trial = Trial(title)
        trials.append(trial)
        folder = (quick if name in NO_DISK else base) / name
        folder.mkdir()
        print(f"{title}: {number} times", file=sys.stderr)
        begun = time.monotonic()
        try:
            do(trial, folder, random.Random(f"{seed} {name}"), number)
        except Exception as error:  # noqa: BLE001 - the others are still to be tried
            trial.expect(False, f"it could not be tried to the end: {type(error).__name__}: {error}")
        trial.seconds = time.monotonic() - begun
        if not trial.found:
            shutil.rmtree(folder)
    print(table(trials))
    found = sum(len(trial.found) for trial in trials)
    if found:
        print(f"{found} found; what they left is in {base} and {quick}, and seed {seed} does it again")
    else:
        shutil.rmtree(base, ignore_errors=True)
        shutil.rmtree(quick, ignore_errors=True)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
