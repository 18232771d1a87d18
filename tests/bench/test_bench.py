"""The benchmark is whole: all rows there, JSON that parses, pictures that are pictures. Never its times."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

RUN = Path(__file__).with_name("run.py")

ROWS = {
    "core.cuboid", "core.deskew", "core.point", "core.ellipsoid", "core.c", "core.c.floor", "core.known",
    "core.order.columns", "core.order.mixed", "core.order.scattered", "core.wide",
    "threads.new", "threads.known", "threads.c",
    "held.10", "held.1000", "held.20000", "held.1000.jumping", "held.20000.jumping",
    "service.shm", "service.tcp", "replay", "log",
    "latency.65k.p50", "latency.65k.p99", "latency.131k.p50", "latency.131k.p99", "planner.p50", "planner.p99",
    "whole.10.p50", "whole.10.p99", "whole.50.p50", "whole.50.p99", "whole.200.p50", "whole.200.p99",
    "tile.idle.p50", "tile.idle.p99", "tile.loaded.p50", "tile.loaded.p99", "derive",
    "region.shm", "region.tcp", "tiles.shm", "tiles.tcp",
    "memory.dense", "memory.drive", "memory.spilling", "start", "start.stored",
}  # fmt: skip
"""Those that must be there."""

PICTURES = ("tiles-held.png", "coherence.png", "latency.png")


@pytest.mark.timeout(600)
def test_quick_benchmark_is_whole(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(RUN), "--quick", "--out", str(tmp_path)],
        capture_output=True, text=True, timeout=580, check=False,
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
