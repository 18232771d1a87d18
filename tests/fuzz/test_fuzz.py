"""Every target over its corpus and some changed inputs of it: what `make fuzz` does at length."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given
from mutations import mutated
from properties import examples
from targets import TARGETS, corpus_of

EXAMPLES = 60
"""A target: seconds in all, most of them the log's and the store's, which go through files."""

MOST_BYTES = 48 << 20
"""That one small input may have allocated at its peak; a tile is 592 KiB, the largest answer that a target takes 1 MiB,
the bound on a log's chunk lies above this, and no input here has a reason to come near."""


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus(target: str) -> None:
    assert corpus_of(target)
    for path in corpus_of(target):
        payload = path.read_bytes()
        tracemalloc.start()
        try:
            TARGETS[target](payload)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < MOST_BYTES, f"{path.name}: {peak} bytes"


@pytest.mark.hypothesis
@pytest.mark.parametrize("target", TARGETS)
def test_changed_inputs(target: str) -> None:
    @examples(EXAMPLES, *HealthCheck)
    @given(mutated(target))
    def some(payload: bytes) -> None:
        TARGETS[target](payload)

    some()


def test_a_finding_is_left_with_the_line_that_shows_it_again(tmp_path: Path) -> None:
    """The whole command, on a target that fails: by its place in a process of its own."""
    here = Path(__file__).parent
    program = (
        "import sys, targets; targets.TARGETS['events'] = lambda payload: 1 / 0; "
        f"sys.argv = ['drive.py', 'events', '1', {str(tmp_path)!r}]; "
        "import drive, pathlib; drive.by_hypothesis('events', 1.0, pathlib.Path(sys.argv[3]))"
    )
    failed = subprocess.run([sys.executable, "-c", program], cwd=here, capture_output=True, text=True, check=False)
    assert failed.returncode != 0
    assert "ZeroDivisionError" in failed.stderr
    found = tmp_path / "events-crash"
    again = [sys.executable, str(here / "run.py"), "--only", "events", "--input", str(found)]
    good = subprocess.run(again, capture_output=True, text=True, check=True)
    assert good.stdout == f"nothing found with {found}\n"


def test_the_command_ends_with_1_and_the_line_of_each_finding(tmp_path: Path) -> None:
    program = (
        "import run, sys; sys.argv = ['run.py', '--only', 'events', '--folder', sys.argv[1]]; "
        "run.one = lambda name, _, folder: run.Outcome(name, '1', '-', [folder / 'events-crash'], False); "
        "sys.exit(run.main())"
    )
    command = [sys.executable, "-c", program, str(tmp_path)]
    done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert f'again: make fuzz ARGS="--only events --input {tmp_path}/events-crash"' in done.stdout
