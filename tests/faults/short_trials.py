"""The trials of `make faults`, a few times each, of a seed that stays."""

import os
import random
import re
import subprocess
import sys
from pathlib import Path

from report import Trial
from trials import TRIALS

RUN = Path(__file__).with_name("run.py")

SHORT = {
    "kills": 1,
    "start": 1,
    "shutdown": 1,
    "power": 8,
    "killcut": 2,
    "cuts": 150,
    "logflips": 40,
    "storeflips": 40,
    "stores": 30,
    "disk": 1,
    "hang": 1,
    "realdisk": 1,
    "clock": 2,
    "links": 2,
    "messages": 20,
}

KILLED = ("kills", "power", "killcut")
"""Those that `test_kills_and_cuts.py` does; `test_faults.py` does the others. Each half takes as long."""


def nothing_is_found(name: str, folder: Path) -> None:
    """Do a trial; fails by what it finds."""
    title, do, full = TRIALS[name]
    if name == "realdisk" and os.geteuid():
        try_in_a_namespace(name, SHORT[name] / full, folder)
        return
    trial = Trial(title)
    do(trial, folder, random.Random(f"tests {name}"), SHORT[name])
    trial.check()


def try_in_a_namespace(name: str, share: float, folder: Path) -> None:
    """Where a user may mount something, other than root."""
    command = ["unshare", "--user", "--map-root-user", "--mount", sys.executable, str(RUN)]
    done = subprocess.run(
        [*command, "--only", name, "--share", str(share)], env={**os.environ, "TMPDIR": str(folder)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert re.search(r"\(real\) +[1-9]\d* +0 ", done.stdout), done.stdout + done.stderr
