"""`make faults`, shortened: the same trials, a few times each, of a seed that stays."""

import os
import re
import subprocess
import sys
from pathlib import Path

import paths  # noqa: F401 - before what it makes importable
import pytest
from report import Trial
from run import TRIALS
from short_trials import KILLED, nothing_is_found

RUN = Path(__file__).with_name("run.py")


@pytest.mark.parametrize("name", [name for name in TRIALS if name not in KILLED])
def test_nothing_is_found(name: str, tmp_path: Path) -> None:
    nothing_is_found(name, tmp_path)


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
