"""A recorded walk as bags gives the map of its NPZ file, to the bit: float64 holds the same numbers."""

import csv
import json
import tomllib
from collections.abc import Callable, Sequence
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from bag_writers import Said, foxglove, write_ros1, write_sqlite
from service_tools import LoggedRun

from roughmap_schemas import Config, encode_odometry
from roughmap_schemas.geometry import quaternion_of
from roughmap_schemas.kinds import Kind
from roughmap_service.cli.main import run
from roughmap_service.inputs.queue import InputMessage

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


def test_the_off_road_sweep_as_a_bag_gives_the_map_of_a_live_run(
    recordings: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sweep of a moving scanner, with the times of its points; its poses are up to 4 s apart."""
    folder = recordings / "offroad_tradr"
    with (folder / "poses" / "lidar_poses.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    said = []
    for row in rows:
        matrix = np.array([float(value) for value in row[1:]]).reshape(3, 4)
        where = {"position": matrix[:, 3].tolist(), "rotation": quaternion_of(matrix[:, :3].tolist())}
        stamp_ns = int(Decimal(row[0]) * 10**9)
        about = {"stamp_ns": stamp_ns, "frame": "map", "child": "lidar", **where}
        said.append(Said("/odom", "odometry", stamp_ns + 1_000_000, about))
    with np.load(folder / "clouds" / "1725981157_851716757.npz") as file:
        cloud = file["cloud"]
    points = np.column_stack((cloud["x"], cloud["y"], cloud["z"], cloud["t"] * 1e-9)).astype("<f8")
    content = {"stamp_ns": 1725981157_851716757, "frame": "lidar", "rows": points}
    said.append(Said("/points", "cloud", said[-1].log_ns + 1, content))
    (tmp_path / "sweep.toml").write_text(
        "[sensors.lidar]\nrange_sigma = 0.02\n[input]\nmax_pose_gap = 5.0\npose_history = 200.0\n"
    )
    config = Config.model_validate(tomllib.loads((tmp_path / "sweep.toml").read_text()))
    with LoggedRun(tmp_path / "logs", config) as live:
        for one in said:
            where, kind, payload = one.content, Kind.POINTS, b""
            if one.kind == "cloud":
                payload = foxglove(one).SerializeToString()
            else:
                kind = Kind.ODOMETRY
                payload = encode_odometry(where["stamp_ns"], "map", where["position"], where["rotation"], None, "lidar")
            now = (one.log_ns - said[0].log_ns) * 1e-9
            live.live.accept(InputMessage(kind, "robot", payload, one.log_ns, now), now)
        live.decide(1e9)
        digest = live.run.map.digest()
    bag = write_sqlite(tmp_path / "bag", said)
    end = ["-c", str(tmp_path / "sweep.toml"), "-o", str(tmp_path / "map.db"), "--json"]
    assert run(["build", str(bag), *end]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["clouds"] == {"integrated": 1}
    assert 94_600 < report["accepted"] <= np.isfinite(points).all(axis=1).sum()
    assert report["digest"] == digest
