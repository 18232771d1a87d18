"""A program that knows only the contract feeds a service, asks it, and gets the numbers of its own calculation."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from processes import environment, running
from stranger import SENSOR

STRANGER = Path(__file__).with_name("stranger.py")


@pytest.mark.parametrize("model", ["point", "cuboid", "ellipsoid"])
def test_a_stranger_agrees(tmp_path: Path, model: str) -> None:
    with running(tmp_path, map={"error_model": model}, sensors={"lidar": SENSOR}) as (service, _):
        (endpoint,) = service.ready()["endpoints"]
        done = subprocess.run(
            [sys.executable, STRANGER, endpoint, model],
            check=False, capture_output=True, text=True, env=environment(), timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        assert told["cells"] > 30, "enough cells to compare"
        assert max(told["counts"]) > 3, "and cells of several points"
