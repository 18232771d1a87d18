"""`make faults`, shortened: the same trials, a few times each, of a seed that stays."""

import os
import random
import re
import subprocess
import sys
from pathlib import Path

import paths  # noqa: F401 - before what it makes importable
import pytest
from report import Trial
from run import TRIALS

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


@pytest.mark.parametrize("name", TRIALS)
def test_nothing_is_found(name: str, tmp_path: Path) -> None:
    title, do, full = TRIALS[name]
    if name == "realdisk" and os.geteuid():
        try_in_a_namespace(name, SHORT[name] / full, tmp_path)
        return
    trial = Trial(title)
    do(trial, tmp_path, random.Random(f"tests {name}"), SHORT[name])
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


def test_the_command_tells_what_it_tried(tmp_path: Path) -> None:
    command = [sys.executable, str(RUN), "--only", "stores", "--share", "0.02"]
    done = subprocess.run([*command, "--seed", "3"], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "seed 3" in done.stderr
    assert "store gone, old, or newer than the log  4      0" in done.stdout


def test_what_is_found_is_reported_and_ends_with_1(tmp_path: Path) -> None:
    trial = Trial("a fault")
    trial.expect(False, "it broke")
    with pytest.raises(AssertionError, match="it broke"):
        trial.check()
    program = (
        "import run, sys; run.TRIALS = {'it': ('a fault', lambda trial, *_: trial.expect(False, 'it broke'), 1)}; "
        "sys.argv = ['run.py', '--seed', '3']; sys.exit(run.main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "1 found; what they left is in" in done.stdout
    assert "seed 3 does it again" in done.stdout


def test_reliability_tells_of_each_trial_how_often_it_is_done() -> None:
    text = (Path(__file__).parents[2] / "RELIABILITY.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| fault \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
    told = [int(line.split("|")[3].replace(",", "")) for line in table.splitlines()]
    full = [times for _, _, times in TRIALS.values()]
    every = list(TRIALS).index("cuts")  # of this one the trial tells how many bytes there were
    assert told.pop(every) >= full.pop(every)
    assert told == full
