"""The benchmark is whole: all rows of the issue on speed, JSON that parses, pictures. Never its times."""

import json
import subprocess
import sys
from pathlib import Path

RUN = Path(__file__).with_name("run.py")

ROWS = {
    "core.cuboid", "core.deskew", "core.point", "core.ellipsoid", "core.c", "core.c.floor", "core.threads",
    "core.order.columns", "core.order.mixed", "core.order.scattered", "core.wide",
    "held.10", "held.1000", "held.20000", "held.1000.jumping", "held.20000.jumping",
}  # fmt: skip
"""Those that must be there."""

PICTURES = ("tiles-held.png", "coherence.png")


def test_quick_benchmark_is_whole(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(RUN), "--quick", "--out", str(tmp_path)],
        capture_output=True, text=True, timeout=220, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    made = json.loads((tmp_path / "bench.json").read_text(), parse_constant=lambda name: f"{name} in JSON")
    rows = {row["key"]: row for row in made["rows"]}
    assert len(rows) == len(made["rows"]), "no row twice"
    assert set(rows) >= ROWS
    for row in rows.values():
        assert isinstance(row["value"], float) or row["note"], f"{row['key']}: neither measured nor said why not"
        assert row["figure"] in done.stdout
    for name in PICTURES:
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG"), name
