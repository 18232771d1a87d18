"""This version against an older one: the same jobs in fresh processes of each in turn, one table.

    python tests/bench/against.py REV [--pairs N] [--only ROW] [--quick] [--data FOLDER]
                                    [--out FOLDER]

REV is any git revision. Its sources are put into a temporary folder and removed at the end, also after Ctrl-C; the new
version is this tree as it is. Both run with this Python and its libraries, on the same scans. A pair is a process of
each version, and gives one ratio; which goes first changes from pair to pair. `--only` names rows or jobs (kernel,
threads, memory, service, region, robot). All by default takes about half an hour; `--quick` shows in some minutes that
all of it works, and its times mean nothing. The table goes to standard output, and with all samples to
FOLDER/against.json.
"""

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from against_load import Load
from against_rows import PAIRS, SPECS, chosen, mark
from against_table import Compared, lines
from against_version import ROOT, Failed, Version, checked_out, git
from table import machine

FIRST_S, LIMIT_S = 900.0, 300.0
"""Of one process. The first compiles, perhaps on a slow and busy machine."""

FAILURES = 2
"""A job is given up once so many of its processes have failed."""

LEGEND = """\
Both in the same Python, with the same libraries and the same scans. A pair is a fresh process of each.
old, new: medians over the pairs. new / old: the median of the pairs' own ratios, beside their quartiles;
where these lie on both sides of 1, no difference is seen (even). kernel: CPU time of one thread; threads: wall time."""


def say(text: str) -> None:
    """Progress, on standard error."""
    print(f"against: {text}", file=sys.stderr, flush=True)


class Comparison:
    """One job's rows, measured in both versions."""

    def __init__(self, job: str, rows: Sequence[Compared], versions: Sequence[Version], given: dict[str, Any]) -> None:
        self.maps: dict[str, dict[str, str]] = {}
        self._job, self._rows, self._versions = job, rows, versions
        self._given = {**given, "keys": [row.spec.key for row in rows]}
        self._failures = 0

    def warm_up(self) -> None:
        """A short process of each version, not counted, which compiles; a version whose process fails has no rows."""
        short = {**self._given, "quick": True}
        self._versions = [version for version in self._versions if self._measure(version, FIRST_S, short)]

    def pair(self, number: int, limit_s: float) -> bool:
        """A process of each, the new first, or the old every other time; False if too many failed by now."""
        order = self._versions if number % 2 else self._versions[::-1]
        taken = {version.name: self._measure(version, limit_s, self._given) for version in order}
        for row in self._rows:
            for name, side in (("old", row.old), ("new", row.new)):
                side.append((taken.get(name) or {}).get(row.spec.key))
        return bool(self._versions) and self._failures < FAILURES

    def so_far(self) -> str:
        """The ratios' medians."""
        return ", ".join(f"{row.spec.key} {row.quartiles[1]:.2f}" for row in self._rows if row.quartiles)

    def other_maps(self) -> list[str]:
        """Names of the maps of which the versions do not make the same bytes."""
        old, new = self.maps.get("old", {}), self.maps.get("new", {})
        return [f"{self._job}, {name}" for name in old.keys() & new.keys() if old[name] != new[name]]

    def _measure(self, version: Version, limit_s: float, given: dict[str, Any]) -> dict[str, float]:
        """Values by row; none, and the rows say why, if the process failed."""
        try:
            made = version.measure(self._job, limit_s, **given)
        except Failed as failed:
            say(f"{self._job}: {version.name}: {failed}")
            self._failures += 1
            for row in self._rows:
                row.why[version.name] = str(failed)
            return {}
        self.maps[version.name] = made["maps"]
        for row in self._rows:
            if row.spec.key in made["missing"]:
                row.why[version.name] = made["missing"][row.spec.key]
        values: dict[str, float] = made["values"]
        return values


def measured(rows: Sequence[Compared], versions: Sequence[Version], given: argparse.Namespace, out: Path) -> list[str]:
    """Measure all rows, job by job; names of maps that are not the same in both."""
    other: list[str] = []
    data = given.data and str(given.data.resolve())
    for job, usual in PAIRS.items():
        own = [row for row in rows if row.spec.job == job]
        if not own:
            continue
        comparison = Comparison(job, own, versions, {"scans": str(out), "quick": given.quick, "data": data})
        pairs = given.pairs or (1 if given.quick else usual)
        say(f"{job}: pairs of processes: {pairs}; the first may compile kernels for a minute or two")
        if not given.quick:
            comparison.warm_up()
        for number in range(pairs):
            on = comparison.pair(number, FIRST_S if given.quick else LIMIT_S)
            say(f"{job}: pair {number + 1} of {pairs}; new / old so far: {comparison.so_far() or 'none'}")
            if not on:
                break
        other += comparison.other_maps()
    return other


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", metavar="REV", help="the old version: a commit, tag or branch of git")
    parser.add_argument("--pairs", type=int, help="pairs of processes of each row [15; 3 to 7 where one takes long]")
    parser.add_argument("--only", action="append", default=[], metavar="ROW", help="this row or job; may be repeated")
    parser.add_argument("--quick", action="store_true", help="few scans, one pair: is it whole?")
    parser.add_argument("--data", type=Path, help="a folder of recordings, for the rows of recorded points")
    parser.add_argument("--out", type=Path, default=Path("bench"), help="for table, JSON and scans [bench]")
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.only if not chosen([name])]:
        parser.error(f"--only {unknown[0]}: expected one of {', '.join([*PAIRS, *(s.key for s in SPECS)])}")
    if given.pairs is not None and given.pairs < 1:
        parser.error(f"--pairs: expected 1 or more, found {given.pairs}")
    try:
        commit = git("rev-parse", "--verify", "--quiet", f"{given.revision}^{{commit}}")
        old, new = git("log", "-1", "--format=%h, %cs, %s", commit), git("describe", "--always", "--dirty=, changed")
    except (OSError, subprocess.SubprocessError):
        parser.error(f"REV: expected a revision of the git repository {ROOT}, found {given.revision!r}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    given.out.mkdir(parents=True, exist_ok=True)
    out = given.out.resolve()
    rows = [Compared(spec, mark(spec, commit)) for spec in chosen(given.only)]
    load = Load()
    with tempfile.TemporaryDirectory(prefix="roughmap-against-", ignore_cleanup_errors=True) as temporary:
        folder = Path(temporary)
        with checked_out(commit, folder) as tree:
            versions = [Version("old", tree, folder / "old"), Version("new", ROOT, folder / "new")]
            other = measured(rows, versions, given, out)
    notes = [
        f"old: {old}",
        f"new: this tree, {new}",
        *LEGEND.splitlines(),
        load.line(),
        *([f"The versions do not make the same maps: {'; '.join(other)}."] if other else []),
        *(["--quick: these times mean nothing."] if given.quick else []),
    ]
    text = "\n".join([*notes, "", *lines(rows)])
    (out / "against.md").write_text(text + "\n")
    record = {"notes": notes, "quick": given.quick, "machine": machine(), "rows": [row.record() for row in rows]}
    (out / "against.json").write_text(json.dumps(record, allow_nan=False, indent=1))
    print(text)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        say("interrupted")
        sys.exit(130)
