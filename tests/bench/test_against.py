"""Versions compared: the table's arithmetic, a whole run, and nothing that is left of it. Never its times."""

import json
import os
import signal
import statistics
import subprocess
import sys
from pathlib import Path

import pytest
from against import Comparison
from against_rows import GOALS, PAIRS, SPECS, chosen, mark
from against_table import Compared, lines
from against_version import ROOT, Failed, Version
from figures import Mark
from hypothesis import given
from hypothesis import strategies as st

RUN = ROOT / "tests" / "bench" / "against.py"
POINT, GAIN = chosen(["kernel.point"])[0], chosen(["threads.new.gain"])[0]
WAIT_S = 400.0
"""A first run may compile kernels, twice, on a busy machine."""

clone = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="an older version comes out of git")
values = st.floats(0.1, 1e4)


def running(text: str) -> list[str]:
    """Command lines of processes in which ``text`` stands."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            found.append(path.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:  # it has ended
            continue
    return [line for line in found if text in line]


@given(pairs=st.lists(st.tuples(values, values), min_size=2, max_size=20))
def test_the_ratio_shown_is_the_median_of_the_pairs_own_with_quartiles(pairs: list[tuple[float, float]]) -> None:
    row = Compared(POINT, None, [old for old, _ in pairs], [new for _, new in pairs])
    expected = statistics.quantiles([new / old for old, new in pairs], method="inclusive")
    assert row.quartiles == pytest.approx(expected, rel=1e-12)  # another order of the same interpolation


def test_a_pair_that_lacks_a_value_gives_no_ratio_but_the_other_value_counts() -> None:
    row = Compared(POINT, None, [10.0, None, 40.0, 10.0], [5.0, 6.0, 10.0, 20.0])
    assert row.ratios == [0.5, 0.25, 2.0]
    assert row.quartiles == (0.375, 0.5, 1.25)
    record = row.record()
    assert (record["old"], record["new"]) == (10.0, 8.0), "medians of what is there"


@pytest.mark.parametrize(
    ("new", "time", "gain"),
    [
        ([8.0, 9.0, 9.5], "better", "worse"),
        ([10.6, 11.0, 12.0], "worse", "better"),
        ([8.0, 9.0, 14.0], "even", "even"),
        ([9.98, 9.97, 9.99], "even", "even"),
        ([5.0, 5.0], "", ""),
    ],
)
def test_better_is_less_time_or_more_gain_beyond_the_quartiles(new: list[float], time: str, gain: str) -> None:
    old: list[float | None] = [10.0] * len(new)
    assert Compared(POINT, None, old, [*new]).verdict == time
    assert Compared(GAIN, None, old, [*new]).verdict == gain


def test_a_mark_judges_the_new_value_or_the_ratio() -> None:
    old: list[float | None] = [10.0, 10.0, 10.0]
    new: list[float | None] = [8.0, 9.0, 9.5]
    assert Compared(POINT, Mark(0.92, "ratio"), old, new).met is True
    assert Compared(POINT, Mark(0.85, "ratio"), old, new).met is False
    assert Compared(GAIN, Mark(9.5, least=True), old, new).met is False
    assert Compared(POINT, Mark(0.92, "ratio"), [None] * 3, new).met is None
    assert "| new / old <= 0.85 | NO" in lines([Compared(POINT, Mark(0.85, "ratio"), old, new)])[-1]


def test_goals_are_marks_of_rows_and_hold_for_their_own_revision_only() -> None:
    keys = {spec.key for spec in SPECS}
    assert len(keys) == len(SPECS)
    assert {spec.job for spec in SPECS} == set(PAIRS)
    for revision, goals in GOALS.items():
        assert goals.keys() <= keys
        for spec in SPECS:
            assert mark(spec, revision + "0" * 33) == goals.get(spec.key, spec.mark)
    assert all(mark(spec, "f" * 40) == spec.mark for spec in SPECS)


def test_a_version_without_a_package_is_not_measured_by_an_installed_one(tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(Failed, match="no package roughmap"):
        Version("old", empty, tmp_path / "old").measure("kernel", WAIT_S, scans=str(tmp_path), keys=[], quick=True)


def test_a_process_that_hangs_is_killed(tmp_path: Path) -> None:
    version = Version("new", ROOT, tmp_path / "new")
    with pytest.raises(Failed, match=r"not done within 0\.1 s"):
        version.measure("service", 0.1, scans=str(tmp_path), keys=[], quick=True)
    assert running(str(tmp_path)) == []


@pytest.mark.timeout(600)
def test_a_row_that_one_version_cannot_do_says_why_and_the_other_is_measured(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    versions = [Version("old", tmp_path / "empty", tmp_path / "old"), Version("new", ROOT, tmp_path / "new")]
    row = Compared(POINT, None)
    comparison = Comparison("kernel", [row], versions, {"scans": str(tmp_path), "quick": True})
    comparison.warm_up()
    assert comparison.pair(0, WAIT_S)
    assert row.old == [None]
    assert row.new[0] is not None
    assert lines([row])[-1] == "- kernel.point: old: RuntimeError: this version has no package roughmap"


@clone
@pytest.mark.timeout(600)
def test_a_quick_comparison_is_whole_and_leaves_nothing(tmp_path: Path) -> None:
    temporary, out = tmp_path / "temporary", tmp_path / "out"
    temporary.mkdir()
    done = subprocess.run(
        [sys.executable, str(RUN), "HEAD", "--quick", "--pairs", "1", "--only", "kernel.point", "--out", str(out)],
        capture_output=True, text=True, timeout=WAIT_S, check=False, env={**os.environ, "TMPDIR": str(temporary)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    made = json.loads((out / "against.json").read_text(), parse_constant=lambda name: f"{name} in JSON")
    (row,) = made["rows"]
    assert row["key"] == "kernel.point"
    assert row["ratio"] == row["new_samples"][0] / row["old_samples"][0]
    assert row["why"] == {}
    assert (out / "against.md").read_text() == done.stdout
    assert list(temporary.iterdir()) == []
    assert str(tmp_path) not in worktrees()


@clone
@pytest.mark.timeout(600)
def test_its_end_leaves_no_sources_and_no_process(tmp_path: Path) -> None:
    """By SIGTERM: a run in the background of a shell, as these tests may be, has its Ctrl-C ignored."""
    arguments = [sys.executable, str(RUN), "HEAD", "--quick", "--only", "kernel.point", "--out", str(tmp_path / "out")]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    with subprocess.Popen(
        arguments, stderr=subprocess.PIPE, text=True, env={**os.environ, "TMPDIR": str(temporary)}
    ) as process:
        assert process.stderr is not None
        assert "kernel: pairs of processes: 1" in process.stderr.readline(), "said once the sources are there"
        assert str(temporary) in worktrees()
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=WAIT_S)
    assert process.returncode == 143
    assert list(temporary.iterdir()) == []
    assert str(tmp_path) not in worktrees()
    assert running(str(temporary)) == []


@pytest.mark.parametrize("wrong", [["no-such-revision"], ["HEAD", "--only", "kernel.nonsense"], ["HEAD", "--pairs=0"]])
def test_what_cannot_be_compared_is_said_in_one_line(wrong: list[str], tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(RUN), *wrong, "--out", str(tmp_path)],
        capture_output=True, text=True, timeout=WAIT_S, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "expected" in done.stderr.splitlines()[-1]


def worktrees() -> str:
    """Those that git knows."""
    return subprocess.run(
        ["git", "-C", str(ROOT), "worktree", "list"], capture_output=True, text=True, timeout=60.0, check=True
    ).stdout
