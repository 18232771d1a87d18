"""A map that `roughmap build` made is gone on from by `roughmap serve`, as the command's help promises."""

import json
from pathlib import Path

import numpy as np
import pytest
from live_service import live_service

from roughmap import RoughMap
from roughmap_client import RoughMapClient
from roughmap_schemas.layers import DEFAULT_SURFACE
from roughmap_service.cli.main import run


def test_a_built_map_is_served(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(5).uniform(-3, 3, (4000, 3))
    np.savetxt("points.xyz", points, fmt="%.17g")
    assert run(["build", "points.xyz", "-o", "map.db", "--set", "map.error_model=ellipsoid", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    own = RoughMap(error_model="ellipsoid", surface=DEFAULT_SURFACE)
    own.add(points, np.eye(3) * (0.02 * 0.02), common=0.02 * 0.02)
    assert report["digest"] == own.digest()
    settings = f'[map]\nerror_model = "ellipsoid"\n[store]\npath = "{tmp_path / "map.db"}"\n'
    with live_service(tmp_path, settings) as service, RoughMapClient("site", connect=service.endpoints) as client:
        region = client.region((-3, -3, 3, 3), ["mean_height", "std_dev"], dtype="f8")
        sequence = client.status().sequence
    assert sequence == report["sequence"] == 1
    expected = own.region((-3, -3, 3, 3), ["mean_height", "std_dev"])
    for layer in ("mean_height", "std_dev"):
        assert np.array_equal(region[layer], expected[layer], equal_nan=True)
