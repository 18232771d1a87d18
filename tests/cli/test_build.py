"""`roughmap build`: what is stored is the map that the library makes of the same points."""

import json
import resource
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from roughmap import Noise, RoughMap, Scan, Trajectory
from roughmap_schemas.layers import DEFAULT_SURFACE
from roughmap_service.cli.main import run
from roughmap_service.store.map_db import Store

RNG = np.random.default_rng(4)
POSE_SIGMA = (0.05, 0.05, 0.05, 0.01, 0.01, 0.01)
"""The configuration's default, as the design gives it."""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def build(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = run(["build", *arguments])
    out, err = capsys.readouterr()
    return code, out, err


def stored(file: Path) -> tuple[str, int]:
    """Read a store; return its map's digest and sequence."""
    store = Store(file)
    cut = store.read_cut()
    assert cut is not None
    again = RoughMap()
    store.load_into(again, cut)
    return again.digest(), again.sequence


def test_placed_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = RNG.uniform(-3, 3, (500, 3))
    np.savez(tmp_path / "points.npz", points=points)
    code, out, _ = build(["points.npz", "-o", "map.db", "--json"], capsys)
    assert code == 0
    by_hand = RoughMap(surface=DEFAULT_SURFACE)
    by_hand.add(points, np.eye(3) * (0.02 * 0.02), 0, common=0.02 * 0.02)
    report = json.loads(out)
    assert report["points"] == report["accepted"] == 500
    assert report["digest"] == by_hand.digest()
    assert stored(tmp_path / "map.db") == (by_hand.digest(), 1)


def test_text_gives_the_same_map_as_the_archive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = RNG.uniform(-3, 3, (200, 3))
    np.savez(tmp_path / "points.npz", points=points)
    # repr of a float64 reads back as the same float64: the same bytes are expected.
    lines = [",".join(repr(float(value)) for value in row) for row in points]
    (tmp_path / "points.csv").write_text("x,y,z\n" + "\n".join(lines))
    assert build(["points.npz", "-o", "a.db"], capsys)[0] == 0
    assert build(["points.csv", "-o", "b.db"], capsys)[0] == 0
    assert stored(tmp_path / "a.db")[0] == stored(tmp_path / "b.db")[0]


def test_scans_with_their_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = RNG.integers(-4000, 4000, (300, 3)).astype(np.int32)
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    pose[1, :3, 3] = 5, 6, 7
    np.savez(
        tmp_path / "scans.npz",
        points=points,
        scan_start=np.array([0, 100, 300]),
        pose=pose,
        stamp_s=np.array([1.0, 1.5]),
    )
    (tmp_path / "here.toml").write_text("[sensors.lidar]\ntranslation = [9.0, 9.0, 9.0]\nrange_sigma = 0.03\n")
    code, out, _ = build(["scans.npz", "-o", "map.db", "-c", "here.toml", "--json"], capsys)
    assert code == 0
    by_hand = RoughMap(surface=DEFAULT_SURFACE)
    covariance = np.diag(np.array(POSE_SIGMA) ** 2)[None]
    for k, (begin, end) in enumerate([(0, 100), (100, 300)]):
        stamp = 1_000_000_000 + 500_000_000 * k
        rotation = Rotation.from_matrix(pose[k, :3, :3]).as_quat()[None]
        trajectory = Trajectory(np.array([stamp]), pose[k, :3, 3][None], rotation, covariance)
        by_hand.add_scan(Scan(points[begin:end] / 1000.0, stamp), trajectory, Noise(0.03))
    assert json.loads(out)["digest"] == by_hand.digest() == stored(tmp_path / "map.db")[0]


def test_scans_need_a_sensor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "s.npz", points=np.ones((4, 3)), scan_start=np.array([0, 4]), pose=np.eye(4)[None])
    code, _, err = build(["s.npz", "-o", "map.db"], capsys)
    assert code == 2
    assert "[sensors.lidar]" in err
    assert "--range-sigma" in err
    assert not (tmp_path / "map.db").exists()


def test_what_is_there_is_kept_unless_forced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "points.npz", points=np.ones((4, 3)))
    (tmp_path / "map.db").write_text("mine")
    code, _, err = build(["points.npz", "-o", "map.db"], capsys)
    assert code == 2
    assert "--force" in err
    assert (tmp_path / "map.db").read_text() == "mine"
    assert build(["points.npz", "-o", "map.db", "--force"], capsys)[0] == 0
    assert stored(tmp_path / "map.db")[1] == 1


@pytest.mark.parametrize(
    ("name", "words"), [("points.xyz", "-o points.db"), ("map.tif", "`roughmap export` writes .tif of it")]
)
def test_a_recording_is_never_overwritten_by_its_map(capsys: pytest.CaptureFixture[str], name: str, words: str) -> None:
    Path("points.xyz").write_text("1 2 3\n")
    code, _, err = build(["points.xyz", "-o", name, "--force"], capsys)
    assert code == 2
    assert words in err
    assert Path("points.xyz").read_text() == "1 2 3\n"


def test_a_full_disk_is_one_line_and_the_map_before_stays(capsys: pytest.CaptureFixture[str]) -> None:
    Path("points.xyz").write_text("1 2 3\n")
    assert build(["points.xyz", "-o", "map.db"], capsys)[0] == 0
    before = stored(Path("map.db"))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))  # no file can grow beyond it
    try:
        code, _, err = build(["points.xyz", "-o", "map.db", "--force"], capsys)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 1
    assert err.startswith("roughmap: map.db: ")
    assert err.count("\n") == 1
    assert stored(Path("map.db")) == before
    assert sorted(path.name for path in Path().iterdir()) == ["map.db", "points.xyz"]


def test_a_torn_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "points.npz").write_bytes(b"PK\x03\x04 torn")
    code, _, err = build(["points.npz", "-o", "map.db"], capsys)
    assert code == 2
    assert "points.npz" in err
    assert err.count("\n") == 1


def test_rejected_points_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.ones((10, 3))
    points[3, 1] = np.nan
    np.savez(tmp_path / "points.npz", points=points)
    code, out, _ = build(["points.npz", "-o", "map.db"], capsys)
    assert code == 0
    assert "9 of 10 points integrated; rejected: 1 not_finite" in out


def test_no_data_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.xyz").write_text("100.5 200.5 55.3\n101.5 200.5 -9999\n102.5 200.5 nan\n103.5 200.5 55.2\n")
    code, out, err = build(["a.xyz", "-o", "map.db", "--json"], capsys)
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert (report["points"], report["accepted"]) == (4, 2)
    assert report["rejected"] == {"no_data": 1, "not_finite": 1}
    by_hand = RoughMap(surface=DEFAULT_SURFACE)
    by_hand.add(
        np.array([[100.5, 200.5, 55.3], [103.5, 200.5, 55.2]]), np.eye(3) * (0.02 * 0.02), 0, common=0.02 * 0.02
    )
    assert report["digest"] == by_hand.digest()


def test_only_no_data(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.xyz").write_text("100.5 200.5 -9999\n")
    code, out, err = build(["a.xyz", "-o", "map.db"], capsys)
    assert code == 0
    assert "0 of 1 points integrated; rejected: 1 no_data" in out
    assert "warning: the map is empty" in err


def test_survey_coordinates_are_printed_in_full(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.xyz").write_text("698362.12 5949119.37 55.0\n698364.12 5949121.37 55.0\n")
    code, out, err = build(["a.xyz", "-o", "map.db"], capsys)
    assert (code, err) == (0, "")
    assert "tiles from x 698361.6 to 698368 m, y 5949113.6 to 5949126.4 m" in out


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (RNG.uniform((698362, 5949119, 55), (698372, 5949129, 56), (99, 3)).astype(np.float32), "too coarse for cells"),
        (RNG.uniform((-93.36, 41.57, 16), (-93.35, 41.58, 17), (99, 3)), "looks like degrees"),
    ],
)
@pytest.mark.parametrize("scans", [False, True], ids=["points", "poses"])
def test_doubts_are_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], points: npt.NDArray[np.floating], said: str, scans: bool
) -> None:
    arrays: dict[str, npt.NDArray[np.generic]] = {"points": points}
    if scans:
        pose = np.tile(np.eye(4, dtype=points.dtype), (99, 1, 1))
        pose[:, :3, 3] = points
        arrays = {"points": np.ones((99, 3)), "scan_start": np.arange(100), "pose": pose}
    np.savez(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    code, out, err = build(["a.npz", "-o", "map.db", "--range-sigma", "0.02", "--json"], capsys)
    assert code == 0
    (warning,) = json.loads(out)["warnings"]
    assert said in warning
    assert err == f"roughmap: warning: {warning}\n"


def test_a_bad_line_or_pose_leaves_the_old_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.savez(tmp_path / "good.npz", points=np.ones((4, 3)))
    assert build(["good.npz", "-o", "map.db"], capsys)[0] == 0
    before = stored(tmp_path / "map.db")
    (tmp_path / "bad.xyz").write_text("1 2 3\n" * 70_000 + "end of file\n")
    pose = np.tile(np.diag([1.0, -1.0, 1.0, 1.0]), (2, 1, 1))
    pose[0] = np.eye(4)
    np.savez(tmp_path / "bad.npz", points=np.ones((4, 3)), scan_start=[0, 2, 4], pose=pose)
    for name, said in (("bad.xyz", "bad.xyz, line 70001: 'end'"), ("bad.npz", "pose 1 (counted from 0): ")):
        code, out, err = build(["good.npz", name, "-o", "map.db", "--force", "--range-sigma", "0.02"], capsys)
        assert (code, out) == (2, "")
        assert said in err
        assert err.count("\n") == 1
        assert stored(tmp_path / "map.db") == before
