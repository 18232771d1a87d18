"""What the ground costs in time, by the comparison with an older version (tests/bench/against.py)."""

import json
import subprocess
import sys
from pathlib import Path

from right_row import Row

AGAINST = Path(__file__).parents[1] / "bench" / "against.py"

MARKS = {"kernel.new": 1.15, "kernel.known": 1.15, "kernel.hall": 1.4, "kernel.offroad": 1.4, "kernel.broken": 1.5}
"""New over old, where the comparison has such a row."""


def rows(revision: str, data: Path, out: Path) -> list[Row]:
    """Ratios of CPU time a point, medians of alternating pairs."""
    command = [sys.executable, str(AGAINST), revision, "--only", "kernel", "--data", str(data), "--out", str(out)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    table = json.loads((out / "against.json").read_text())["rows"]
    return [
        Row("bench", row["figure"], "x", row["ratio"] if row["ratio"] is not None else float("nan"),
            MARKS.get(row["key"]), note=f"against {revision}")
        for row in table
    ]  # fmt: skip
