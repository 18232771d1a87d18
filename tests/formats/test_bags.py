"""Bags and MCAP files: each kind gives the same messages, what is unclear is said, and what is damaged is found."""

import json
import re
import sqlite3
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from backports import zstd
from bag_writers import (
    T0,
    Said,
    cloud,
    drive,
    pose,
    write_foxglove,
    write_mcap_folder,
    write_mcap_ros2,
    write_ros1,
    write_sqlite,
)
from google.protobuf.json_format import MessageToDict

from roughmap_schemas import SensorConfig, decode_cloud, decode_odometry, decode_transform
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.ros2_sections import Ros2RobotConfig
from roughmap_service.formats.clouds import read_cloud
from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import CloudFileFault, Contents

Write = Callable[[Path, Sequence[Said]], Path]


def with_json(file: Path, said: Sequence[Said]) -> Path:
    """Write Foxglove's messages as its own JSON has them: times as seconds and nanoseconds."""

    def encode(message: object) -> bytes:
        value = MessageToDict(message, preserving_proto_field_name=True, use_integers_for_enums=True)  # type: ignore[arg-type]
        text = json.dumps(value)
        stamp = re.compile(r'"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(?:\.(\d+))?Z"')

        def times(found: re.Match[str]) -> str:
            seconds = int(np.datetime64(found[1], "s").astype(np.int64))
            return json.dumps({"sec": seconds, "nsec": int((found[2] or "0").ljust(9, "0"))})

        return stamp.sub(times, text).encode()

    return write_foxglove(file, said, "json", encode)


KINDS: dict[str, Write] = {
    "sqlite": lambda folder, said: write_sqlite(folder / "bag", said),
    "sqlite file": lambda folder, said: write_sqlite(folder / "bag", said) / "drive_0.db3",
    "sqlite zstd": lambda folder, said: write_sqlite(folder / "bag", said, zstd.compress),
    "mcap folder": lambda folder, said: write_mcap_folder(folder / "bag", said),
    "mcap file": lambda folder, said: write_mcap_ros2(folder / "bag.mcap", said),
    "ros 1": lambda folder, said: write_ros1(folder / "bag.bag", said),
    "foxglove": lambda folder, said: write_foxglove(folder / "bag.mcap", said),
    "foxglove json": lambda folder, said: with_json(folder / "bag.mcap", said),
}
EACH = pytest.mark.parametrize("kind", KINDS)


def read(path: Path, **options: object) -> tuple[Contents, list[RobotMessage], list[str]]:
    """Return what a recording holds, its messages, and the notes."""
    notes: list[str] = []
    contents, *messages = read_cloud(path, ReadOptions(note=notes.append, **options))  # type: ignore[arg-type]
    assert isinstance(contents, Contents)
    assert all(isinstance(one, RobotMessage) for one in messages)
    return contents, messages, notes  # type: ignore[return-value]  # as asserted


def fault(path: Path, **options: object) -> str:
    with pytest.raises(CloudFileFault) as caught:
        read(path, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    return text


@EACH
def test_every_kind_of_bag_gives_the_same_messages(kind: str, tmp_path: Path) -> None:
    said = drive()
    contents, messages, notes = read(KINDS[kind](tmp_path, said))
    assert contents == Contents("map", frozenset(("velodyne",)))
    assert notes == []
    assert Counter(one.kind for one in messages) == {Kind.ODOMETRY: 160, Kind.POINTS: 30, Kind.TRANSFORM: 1}
    assert [one.log_ns for one in messages] == sorted(one.log_ns for one in messages)
    (tmp_path / "other").mkdir()
    assert messages == read(KINDS["sqlite"](tmp_path / "other", said))[1]
    mount = decode_transform(next(m for m in messages if m.kind is Kind.TRANSFORM).payload, max_message=1 << 16)
    assert (mount.parent_frame_id, mount.child_frame_id, mount.translation) == ("base_link", "velodyne", (0.25, 0, 1))
    poses = [decode_odometry(m.payload, max_message=1 << 16) for m in messages if m.kind is Kind.ODOMETRY]
    assert [p.stamp_ns for p in poses] == [one.content["stamp_ns"] for one in said if one.kind == "odometry"]


@EACH
def test_a_share_of_a_bag_is_read_lazily(kind: str, tmp_path: Path) -> None:
    said = [one for one in drive() if one.kind != "cloud"]
    said += (Said("/p", "cloud", said[-1].log_ns + k, cloud(0.1 * k, points=20_000)) for k in range(1, 41))
    path = KINDS[kind](tmp_path, said)
    size = sum(file.stat().st_size for file in ([path] if path.is_file() else path.iterdir()))
    del said
    tracemalloc.start()
    try:
        number = sum(1 for _ in read_cloud(path))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert number > 200
    assert peak < 8_000_000 < 40 * 320_000
    assert size > 0


def test_poses_from_tf_are_read_without_odometry(tmp_path: Path) -> None:
    said = [one for one in drive() if one.kind != "odometry"]
    said += (Said("/tf", "tf", T0 + k * 20_000_000, pose(0.02 * k, "odom")) for k in range(200))
    contents, messages, notes = read(KINDS["mcap file"](tmp_path, sorted(said, key=lambda one: one.log_ns)))
    assert contents == Contents("odom", frozenset(("velodyne",)))
    assert [note.split(": ", 1)[1] for note in notes] == ["no frame 'map' in it; its poses are mapped in 'odom'"]
    poses = [decode_odometry(m.payload, max_message=1 << 16) for m in messages if m.kind is Kind.ODOMETRY]
    assert {p.frame_id for p in poses} == {"odom"}
    assert len(poses) > 100


def test_static_transforms_hold_from_the_beginning(tmp_path: Path) -> None:
    said = [one._replace(log_ns=one.log_ns + 10**9) if one.kind == "tf" else one for one in drive()]
    _, messages, _ = read(KINDS["mcap folder"](tmp_path, sorted(said, key=lambda one: one.log_ns)))
    assert messages[0].kind is Kind.TRANSFORM
    assert len(messages) == 191


def test_odometry_without_a_map_is_mapped_in_its_own_frame(tmp_path: Path) -> None:
    contents, _, notes = read(KINDS["sqlite"](tmp_path, drive(frame="odom")))
    assert contents.map_frame == "odom"
    assert len(notes) == 1
    assert "no frame 'map'" in notes[0]
    assert "'odom'" in notes[0]


def test_a_bag_without_poses_says_how_kiss_icp_makes_them(tmp_path: Path) -> None:
    said = [one for one in drive() if one.kind != "odometry"]
    text = fault(KINDS["mcap folder"](tmp_path, said))
    assert "no odometry" in text
    assert f"kiss_icp_pipeline --dataloader rosbag --topic /velodyne_points {tmp_path / 'bag'}, then" in text
    assert text.endswith("--poses results/latest/bag_poses_kitti.txt")
    (tmp_path / "old").mkdir()
    text = fault(KINDS["sqlite"](tmp_path / "old", said))  # of Humble: without definitions
    assert f"rosbags-convert --src {tmp_path / 'old/bag'} --dst {tmp_path / 'old/bag_typed'}" in text
    assert text.endswith("--poses results/latest/bag_typed_poses_kitti.txt")


def test_several_topics_of_clouds_are_listed_with_the_option_that_chooses(tmp_path: Path) -> None:
    said = sorted([*drive(), *(one for one in drive(topic="/filtered") if one.kind == "cloud")], key=lambda m: m.log_ns)
    path = KINDS["sqlite"](tmp_path, said)
    text = fault(path)
    assert "/filtered (30 messages), /velodyne_points (30 messages)" in text
    assert "--clouds" in text
    assert len(read(path, clouds=("/filtered",))[1]) == 191
    assert "no such topic" in fault(path, clouds=("/none",))


def test_several_topics_of_odometry_are_listed_with_the_option_that_chooses(tmp_path: Path) -> None:
    said = drive()
    said += (one._replace(topic="/fused") for one in drive() if one.kind == "odometry")
    path = KINDS["sqlite"](tmp_path, sorted(said, key=lambda one: one.log_ns))
    text = fault(path)
    assert "/fused (160 messages), /odom (160 messages)" in text
    assert "--odometry" in text
    assert len(read(path, odometry="/fused")[1]) == 191


def test_clouds_of_no_configured_sensor_are_named(tmp_path: Path) -> None:
    path = KINDS["sqlite"](tmp_path, drive())
    text = fault(path, any_sensor=False)
    assert "/velodyne_points in 'velodyne'" in text
    assert "--range-sigma" in text
    configured = {"velodyne": SensorConfig(range_sigma=0.02)}
    contents, messages, _ = read(path, any_sensor=False, sensors=configured)
    assert contents.mounted == frozenset()
    assert len(messages) == 190


def test_a_configured_robot_has_its_topics(tmp_path: Path) -> None:
    said = drive()
    said += (one._replace(topic="/other") for one in drive() if one.kind == "cloud")
    path = KINDS["mcap folder"](tmp_path, sorted(said, key=lambda one: one.log_ns))
    topics = Ros2RobotConfig.model_validate({"clouds": ["/other"], "odometry": "/odom"})
    assert len(read(path, topics=topics)[1]) == 191
    missing = Ros2RobotConfig.model_validate({"clouds": ["/none"], "odometry": "/odom"})
    assert "/none" in fault(path, topics=missing)


def test_a_message_that_is_none_is_left_out_and_said(tmp_path: Path) -> None:
    path = KINDS["sqlite"](tmp_path, drive())
    with sqlite3.connect(path / "drive_0.db3") as base:
        base.execute("UPDATE messages SET data = x'00010000ff' WHERE id = 100")
    base.close()
    _, messages, notes = read(path)
    assert len(messages) == 190
    assert len(notes) == 1
    assert "1 messages were left out" in notes[0]


@pytest.mark.parametrize("kind", ["mcap file", "mcap folder", "foxglove", "ros 1", "sqlite"])
def test_a_bag_cut_off_is_named_with_the_offset(kind: str, tmp_path: Path) -> None:
    path = KINDS[kind](tmp_path, drive())
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix in {".mcap", ".db3"})
    whole = file.read_bytes()
    length = len(whole) * 2 // 3
    file.write_bytes(whole[:length])
    text = fault(path)
    offset = int(re.search(r"damaged at offset (\d+)", text)[1])  # type: ignore[index]
    assert str(file) in text
    assert length - 40_000 < offset <= length
    assert any(remedy in text for remedy in ("mcap recover", "rosbag reindex", ".recover"))


@pytest.mark.parametrize("kind", ["mcap file", "foxglove"])
def test_a_damaged_chunk_is_named_with_its_offset(kind: str, tmp_path: Path) -> None:
    path = KINDS[kind](tmp_path, drive())
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    offset = int(re.search(r"damaged at offset (\d+)", fault(path))[1])  # type: ignore[index]
    assert content[offset] == 0x06
    assert offset <= len(content) // 2


def test_a_reader_left_early_closes_its_files(tmp_path: Path) -> None:
    for kind, write in KINDS.items():
        (tmp_path / kind).mkdir()
        parts = read_cloud(write(tmp_path / kind, drive()))
        assert len(list(islice(parts, 5))) == 5
        parts.close()  # type: ignore[attr-defined]  # a generator; a file left open would be a warning, so an error


def test_livox_messages_are_read_from_both_kinds_of_bags(tmp_path: Path) -> None:
    said = [one for one in drive() if one.kind != "cloud"]
    for k in range(5):
        rows = np.abs(cloud(0.1 * k)["rows"])
        rows[:, 3] = np.linspace(0, 0.09, len(rows))
        content = {"stamp_ns": T0 + k * 10**8, "frame": "velodyne", "rows": rows}
        said.append(Said("/livox/lidar", "livox", said[-1].log_ns + 1, content))
    new, old = read(KINDS["sqlite"](tmp_path, said))[1], read(KINDS["ros 1"](tmp_path, said))[1]
    assert new == old
    clouds = [decode_cloud(m.payload, max_message=1 << 20, max_points=1000) for m in new if m.kind is Kind.POINTS]
    assert [np.array_equal(c.points, one.content["rows"][:, :3]) for c, one in zip(clouds, said[-5:], strict=True)] == [
        True
    ] * 5


def test_a_goal_is_no_pose_of_the_robot(tmp_path: Path) -> None:
    said = [one for one in drive() if one.kind != "odometry"]
    said += (Said("/goal_pose", "pose_stamped", T0 + k * 10**8 + 5, pose(0.1 * k)) for k in range(30))
    said.sort(key=lambda one: one.log_ns)
    assert "no odometry" in fault(KINDS["sqlite"](tmp_path, said))
    (tmp_path / "other").mkdir()
    said = [one._replace(topic="/slam/pose") if one.topic == "/goal_pose" else one for one in said]
    messages = read(KINDS["sqlite"](tmp_path / "other", said))[1]
    assert Counter(one.kind for one in messages)[Kind.ODOMETRY] == 30


def trajectory(path: Path, stamps_ns: Sequence[int]) -> Path:
    lines = [f"{ns / 1e9:.4f} {0.08 * k:.4f} 0.0 1.0 0.0 0.0 0.0 1.0" for k, ns in enumerate(stamps_ns)]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("by", ["stamp", "log"])
def test_a_trajectory_gives_the_poses_of_clouds(by: str, tmp_path: Path) -> None:
    clouds = [one for one in drive() if one.kind == "cloud"]
    stamps = [one.content["stamp_ns"] for one in clouds]
    poses = trajectory(tmp_path / "traj.txt", stamps if by == "stamp" else [one.log_ns for one in clouds])
    contents, messages, _ = read(KINDS["sqlite"](tmp_path, clouds), poses=poses)
    assert contents == Contents("map", placed=frozenset(("velodyne",)))
    found = [decode_odometry(m.payload, max_message=1 << 16) for m in messages if m.kind is Kind.ODOMETRY]
    assert [p.stamp_ns for p in found] == stamps
    assert [p.position[0] for p in found] == [round(0.08 * k, 4) for k in range(30)]


def test_numbered_poses_belong_to_the_clouds_in_turn(tmp_path: Path) -> None:
    clouds = [one for one in drive() if one.kind == "cloud"]
    lines = [f"1 0 0 {0.08 * k!r} 0 1 0 0 0 0 1 1" for k in range(30)]
    (tmp_path / "kitti.txt").write_text("\n".join(lines))
    bag = KINDS["ros 1"](tmp_path, clouds)
    messages = read(bag, poses=tmp_path / "kitti.txt")[1]
    found = [decode_odometry(m.payload, max_message=1 << 16) for m in messages if m.kind is Kind.ODOMETRY]
    assert [p.stamp_ns for p in found] == [one.content["stamp_ns"] for one in clouds]
    assert [p.position[0] for p in found] == [0.08 * k for k in range(30)]
    (tmp_path / "kitti.txt").write_text("\n".join(lines[1:]))
    with pytest.raises(CloudFileFault, match="29 poses without stamps for the 30 clouds"):
        read(bag, poses=tmp_path / "kitti.txt")
