"""A program that knows only the contract feeds a service, asks it, and gets the numbers of its own calculation."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from processes import environment, events_in, running
from stranger import SENSOR

from roughmap_schemas import CheckpointEvent

STRANGER = Path(__file__).with_name("stranger.py")


@pytest.mark.parametrize("model", ["point", "cuboid", "ellipsoid"])
def test_a_stranger_agrees(tmp_path: Path, model: str) -> None:
    settings = {"map": {"error_model": model, "surface": "all"}, "sensors": {"lidar": SENSOR}}
    with running(tmp_path, **settings) as (service, _):
        (endpoint,) = service.ready()["endpoints"]
        done = subprocess.run(
            [sys.executable, STRANGER, endpoint, model],
            check=False, capture_output=True, text=True, env=environment(), timeout=120,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        assert told["cells"] > 30, "enough cells to compare"
        assert max(told["counts"]) > 3, "and cells of several points"
    *_, last = (event for event in events_in(service.log) if isinstance(event, CheckpointEvent))
    assert told["digest"] == last.digest, "the bytes of the whole map"
