"""`make fuzz`: every target in turn, and a table of what came of it.

make fuzz ARGS="--seconds 600"            # shared over the targets
make fuzz ARGS="--only cloud --only log"  # some of them
make fuzz ARGS="--input fuzz/log-crash-1a2b --only log"   # one input again, as a finding's line says
"""

import argparse
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from drive import HAS_ATHERIS, INPUT_SECONDS
from targets import TARGETS

DRIVE = Path(__file__).parent / "drive.py"
START_SECONDS = 120
"""More than the slowest start, with all modules instrumented, takes."""


class Outcome(NamedTuple):
    target: str
    runs: str
    coverage: str
    found: list[Path]
    ok: bool


def one(target: str, seconds: float, folder: Path) -> Outcome:
    """A target's share. What its process says is kept beside the inputs, if it found something."""
    before = set(folder.iterdir())
    said = folder / f"{target}.txt"
    with said.open("w") as log:
        command = [sys.executable, str(DRIVE), target, str(seconds), str(folder)]
        code = subprocess.run(
            command, stderr=log, stdout=log, check=False, timeout=seconds + START_SECONDS + INPUT_SECONDS
        ).returncode
    text = said.read_text(errors="replace")
    runs = re.findall(r"number_of_executed_units: *(\d+)", text) or re.findall(r"^#(\d+)", text, re.M)
    coverage = re.findall(r"\bcov: (\d+)", text)
    found = sorted(path for path in set(folder.iterdir()) - before if path != said)
    if not found and code == 0:
        said.unlink()
    return Outcome(target, runs[-1] if runs else "?", coverage[-1] if coverage else "-", found, code == 0 and not found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600, help="in all (default: 600)")
    parser.add_argument("--only", action="append", choices=TARGETS, help="a target; may stand several times")
    parser.add_argument("--folder", type=Path, default=Path("fuzz"), help="where findings are left (default: fuzz)")
    parser.add_argument("--input", type=Path, help="run this one input, and nothing else")
    options = parser.parse_args()
    names = options.only or list(TARGETS)
    if options.input is not None:
        for name in names:
            TARGETS[name](options.input.read_bytes())
        print(f"nothing found with {options.input}")
        return 0
    if not HAS_ATHERIS:
        print("atheris is not installed here: Hypothesis drives the targets, not guided by coverage", file=sys.stderr)
    options.folder.mkdir(parents=True, exist_ok=True)
    share = max(options.seconds / len(names), 1.0)
    outcomes = []
    for number, name in enumerate(names, 1):
        print(f"[{number}/{len(names)}] {name}, {share:.0f} s", file=sys.stderr)
        outcomes.append(one(name, share, options.folder))
    print(f"{'target':<16}{'runs':>12}{'coverage':>10}{'found':>7}")
    for outcome in outcomes:
        print(f"{outcome.target:<16}{outcome.runs:>12}{outcome.coverage:>10}{len(outcome.found):>7}")
    for outcome in outcomes:
        if not outcome.ok:
            print(f"{outcome.target}: see {options.folder / outcome.target}.txt")
        for path in outcome.found:
            print(f'again: make fuzz ARGS="--only {outcome.target} --input {path}"')
    return 0 if all(outcome.ok for outcome in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
