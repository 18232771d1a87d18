"""`roughmap simulate`, heard by a Zenoh subscriber: all messages, numbered, in order, at the rate asked for."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from bag_writers import drive, write_sqlite
from net import Gathered, open_listener
from recordings import STAMPS_S, write_recording

from roughmap_schemas.cloud import decode_cloud
from roughmap_schemas.encodings import ODOMETRY, POINT_CLOUD
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.odometry import decode_odometry
from roughmap_service.cli.main import run
from roughmap_service.formats.clouds import read_cloud

Heard = tuple[str, bytes, int, str]
"""Key, payload, message_seq, encoding."""

SMALL = ["--rings", "4", "--columns", "16", "--json"]


@contextmanager
def robots_heard() -> Iterator[tuple[str, Gathered[Heard]]]:
    """An endpoint, and what is put there on the keys of robots."""
    heard: Gathered[Heard] = Gathered()

    def take(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        number = int.from_bytes(sample.attachment.to_bytes(), "little")
        heard((str(sample.key_expr), sample.payload.to_bytes(), number, str(sample.encoding)))

    with open_listener() as (session, endpoints):
        session.declare_subscriber("robots/**", take)
        yield endpoints[0], heard


def simulated(
    arguments: list[str], count: int, capsys: pytest.CaptureFixture[str]
) -> tuple[dict[str, Any], list[Heard]]:
    """What the command reports, and the `count` messages that were heard."""
    with robots_heard() as (endpoint, heard):
        assert run(["simulate", "--connect", endpoint, *arguments]) == 0
        messages = heard.wait(lambda items: len(items) >= count, f"{count} messages")
    return json.loads(capsys.readouterr().out), messages


def by_key(messages: list[Heard]) -> dict[str, list[Heard]]:
    found: dict[str, list[Heard]] = {}
    for message in messages:
        found.setdefault(message[0], []).append(message)
    return found


def test_all_at_once_nothing_is_lost_and_all_is_numbered(capsys: pytest.CaptureFixture[str]) -> None:
    # Of 3 s: 30 sweeps, and poses at 50 Hz from the first sweep's start to one past the last one's end, of each robot.
    arguments = ["--duration", "3", "--rate", "0", "--robots", "2", "--start-ns", "1000000000", *SMALL]
    report, messages = simulated(arguments, 2 * (30 + 152), capsys)
    assert (report["clouds"], report["poses"]) == (60, 304)
    assert report["bytes"] == sum(len(payload) for _, payload, _, _ in messages)
    keys = by_key(messages)
    assert {key: len(found) for key, found in keys.items()} == {
        f"robots/rover{n}/{kind}": count for n in (1, 2) for kind, count in (("points", 30), ("odometry", 152))
    }
    for key, found in keys.items():
        assert [number for _, _, number, _ in found] == list(range(len(found)))
        assert {encoding for _, _, _, encoding in found} == {POINT_CLOUD if key.endswith("points") else ODOMETRY}


def test_the_messages_are_a_rover_s(capsys: pytest.CaptureFixture[str]) -> None:
    _, messages = simulated(["--duration", "0.5", "--rate", "0", "--start-ns", "5", *SMALL], 5 + 27, capsys)
    keys = by_key(messages)
    clouds = [decode_cloud(m[1], max_message=1 << 20, max_points=1 << 16) for m in keys["robots/rover1/points"]]
    poses = [decode_odometry(m[1], max_message=1 << 16) for m in keys["robots/rover1/odometry"]]
    assert [cloud.stamp_ns for cloud in clouds] == [5 + k * 100_000_000 for k in range(5)]
    assert [pose.stamp_ns for pose in poses] == [5 + k * 20_000_000 for k in range(27)]
    assert {len(cloud.points) for cloud in clouds} == {4 * 16}
    assert {cloud.frame_id for cloud in clouds} == {"lidar"}
    assert all(pose.covariance is not None for pose in poses)


def test_at_its_own_rate_it_takes_its_time(capsys: pytest.CaptureFixture[str]) -> None:
    # The last pose is due 0.4 s after the first one: waiting may take longer than it should, but never shorter.
    report, _ = simulated(["--duration", "0.4", *SMALL], 1, capsys)
    assert report["seconds"] >= 0.4
    assert report["clouds"] == 4


def test_a_recording_is_played_under_the_names_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = write_recording(tmp_path / "scans.npz")
    arguments = ["--from", str(file), "--robot", "walker", "--sensor-frame", "head", "--rate", "0", "--json"]
    report, messages = simulated(arguments, 6, capsys)
    assert (report["clouds"], report["poses"]) == (3, 3)
    keys = by_key(messages)
    assert set(keys) == {"robots/walker/points", "robots/walker/odometry"}
    recorded = np.load(file)
    for k, message in enumerate(keys["robots/walker/points"]):
        cloud = decode_cloud(message[1], max_message=1 << 20, max_points=1 << 16)
        assert (cloud.frame_id, cloud.stamp_ns) == ("head", int(STAMPS_S[k] * 1e9))
        assert np.array_equal(cloud.points, recorded["points"][8000 * k : 8000 * (k + 1)] / 1000)
    for k, message in enumerate(keys["robots/walker/odometry"]):
        pose = decode_odometry(message[1], max_message=1 << 16)
        assert np.array_equal(pose.position, recorded["pose"][k, :3, 3])


def test_the_messages_of_a_bag_go_out_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_sqlite(tmp_path / "bag", drive(1.0))
    recorded = [part for part in read_cloud(bag) if isinstance(part, RobotMessage)]
    report, messages = simulated(["--from", str(bag), "--robot", "r1", "--rate", "0", "--json"], len(recorded), capsys)
    assert (report["clouds"], report["poses"]) == (10, 60)
    keys = by_key(messages)
    for kind in Kind.POINTS, Kind.ODOMETRY, Kind.TRANSFORM:
        assert [m[1] for m in keys[f"robots/r1/{kind}"]] == [m.payload for m in recorded if m.kind is kind]


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"points": np.zeros((3, 2))}, "numeric points"),
        ({"points": np.zeros((3, 3)), "scan_start": np.array([0, 9]), "pose": np.eye(4)[None]}, "at most 3"),
    ],
)
def test_a_recording_that_is_none_is_said_before_a_service_is_sought(
    tmp_path: Path, arrays: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "scans.npz", **arrays)
    # Port 1 on loopback: nobody listens there.
    code = run(["simulate", "--from", str(tmp_path / "scans.npz"), "--connect", "tcp/127.0.0.1:1", "--wait", "30"])
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert said in err
    assert "scans.npz" in err
    assert err.count("\n") == 1
