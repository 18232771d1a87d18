"""A recorded walk as bags gives the map of its NPZ file, to the bit: float64 holds the same numbers."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from bag_writers import Said, write_ros1, write_sqlite

from roughmap_schemas.geometry import quaternion_of
from roughmap_service.cli.main import run

Write = Callable[[Path, Sequence[Said]], Path]


def said_of(file: Path) -> list[Said]:
    """The scans as clouds in the frame of the robot's base, each after its pose."""
    recorded = np.load(file)
    said = []
    for k, stamp_s in enumerate(recorded["stamp_s"].tolist()):
        stamp_ns = round(np.rint(stamp_s * 1e9))
        pose = recorded["pose"][k]
        where = {"position": pose[:3, 3].tolist(), "rotation": quaternion_of(pose[:3, :3].tolist())}
        about = {"stamp_ns": stamp_ns, "frame": "map", "child": "lidar", **where}
        said.append(Said("/odom", "odometry", stamp_ns + 1_000_000, about))
        rows = recorded["points"][slice(*recorded["scan_start"][k : k + 2])] / 1000.0
        content = {"stamp_ns": stamp_ns, "frame": "lidar", "rows": rows.astype("<f8")}
        said.append(Said("/points", "cloud", stamp_ns + 50_000_000, content))
    return said


@pytest.mark.parametrize("write", [write_sqlite, write_ros1], ids=["rosbag2", "ros 1"])
def test_the_hall_sequence_as_a_bag_gives_the_map_of_its_npz(
    write: Write, recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hall = recordings / "hall_sequence.npz"
    digests, end = [], ["-o", str(tmp_path / "map.db"), "--force", "--range-sigma", "0.02", "--json"]
    for path in (hall, write(tmp_path / "hall.bag", said_of(hall))):
        assert run(["build", str(path), *end]) == 0
        out, err = capsys.readouterr()
        assert err == ""
        digests.append(json.loads(out)["digest"])
    assert digests[0] == digests[1]
