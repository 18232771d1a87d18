"""The example in schemas/examples, which knows schemas/README.md alone, against a real service."""

import ast
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

from processes import environment, running

from roughmap_schemas import CONTRACT_VERSION

EXAMPLE = Path(__file__).parents[2] / "schemas" / "examples" / "raw_client.py"


def run(*arguments: str) -> dict[str, Any]:
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), *arguments],
        check=False, capture_output=True, text=True, timeout=120, env={**environment(), "PYTHONPATH": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def test_it_knows_no_roughmap() -> None:
    tree = ast.parse(EXAMPLE.read_text(encoding="utf-8"))
    imported = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert not [name for name in imported if name.startswith("roughmap")]


def test_the_raw_client(tmp_path: Path) -> None:
    settings = tomllib.loads(EXAMPLE.with_suffix(".toml").read_text(encoding="utf-8"))
    with running(tmp_path, **settings) as (service, feed):
        before = feed.settle().input
        (endpoint,) = service.ready()["endpoints"]
        told = run("drive", endpoint)
    assert told["same_input"]
    assert told["duplicates"] == [False, True]
    assert told["outcomes"] == ["integrated", "integrated"]
    assert told["accepted"] == 400
    assert told["poses"] == 4
    assert told["tiles"] == [[0, -1], [0, 0], [1, 0]]
    # A cell with one point may be known, and its ground not be.
    assert told["known_cells"] >= told["known_in_tiles"] > 400
    assert told["region"]["shape"] == [18, 18]
    assert told["region"]["origin"] == [0.6, -0.9]
    assert told["region"]["largest_height"] < 1e-6, "the ground is flat, at 0"
    first, second = told["cells"]
    assert (first["i"], first["j"], first["state"]["count"]) == (100, 0, 2)
    assert first["layers"] == {"mean_height": 1.25, "std_dev": 0.0}
    assert (second["state"], second["layers"]["mean_height"]) == (None, None)
    assert told["refused"] == "bad_bbox"
    assert told["updates_applied"]
    assert told["held_is_map"]
    status = told["status"]
    assert (status["contract"], status["map"], status["sequence"]) == (CONTRACT_VERSION, "site", 2)
    assert (status["input"], status["health"]) == (before + 6, "ok")
    assert (status["refused"], status["gaps"]) == ({}, {})
    assert told["alive"] == [True]

    log = run("log", str(service.log))
    assert (log["runs"], log["inputs"]) == (1, before + 6)
    assert log["topics"]["robots/rover1/points"] == 2
    assert log["topics"]["robots/rover1/odometry"] == 4
    assert log["events"]["integration"] == 2
    assert log["events"]["checkpoint"] >= 1
    assert log["topics"]["maps/site/queries"] >= 4
