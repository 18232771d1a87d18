"""`roughmap build` of robots' messages: the map that a service makes of them, and what is said of those left out."""

import json
import signal
import threading
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import pytest
from bag_writers import (
    MOUNT,
    T0,
    Said,
    drive,
    foxglove,
    write_foxglove,
    write_mcap_folder,
    write_mcap_ros2,
    write_ros1,
    write_sqlite,
)
from replay_tools import stored
from service_tools import LoggedRun

from roughmap_schemas import Config, encode_odometry, encode_transform
from roughmap_schemas.kinds import Kind
from roughmap_schemas.reasons import CloudReason
from roughmap_service.cli.main import run as command
from roughmap_service.formats.options import ReadOptions
from roughmap_service.inputs.queue import InputMessage
from roughmap_service.offline.building import Progress, Wanted, build_map, interrupting
from roughmap_service.offline.message_run import TAKEN, Counts
from roughmap_service.offline.unmapped import why_unmapped

LEVEL = (0.0, 0.0, 0.0, 1.0)
SENSOR = {"range_sigma": 0.03, "extrinsics": "transform"}


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def live(folder: Path, said: Sequence[Said]) -> LoggedRun:
    """Give the messages to a live run as they came, in the contract's own encoding."""
    with LoggedRun(folder, Config.model_validate({"sensors": {"velodyne": SENSOR}})) as run:
        for one in said:
            content, now = one.content, (one.log_ns - T0) * 1e-9
            if one.kind == "tf":
                kind, payload = Kind.TRANSFORM, encode_transform(0, "base_link", "velodyne", MOUNT, LEVEL)
            elif one.kind == "odometry":
                kind = Kind.ODOMETRY
                payload = encode_odometry(content["stamp_ns"], "map", content["position"], LEVEL, None, "base_link")
            else:
                kind, payload = Kind.POINTS, foxglove(one).SerializeToString()
            assert run.live.accept(InputMessage(kind, "robot", payload, one.log_ns, now), now) is not None
            run.decide(now)
        run.decide(1e9)
        run.checkpoint()
    return run


def build(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, object], str]:
    code = command(["build", *map(str, arguments), "-o", "map.db", "--force", "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else {}, err


def test_every_kind_of_bag_gives_the_map_of_a_live_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = drive()
    digest = live(tmp_path / "logs", said).run.map.digest()
    (tmp_path / "split").mkdir()
    bags = [
        write_sqlite(tmp_path / "sqlite", said),
        write_mcap_folder(tmp_path / "mcap", said),
        write_mcap_ros2(tmp_path / "file.mcap", said),
        write_ros1(tmp_path / "ros1.bag", said),
        write_foxglove(tmp_path / "foxglove.mcap", said),
    ]
    for path in bags:
        code, report, err = build(capsys, path, "--range-sigma", "0.03")
        assert (code, err) == (0, "")
        assert (report["clouds"], report["poses"]) == ({"integrated": 30}, {"taken": 160})
        assert report["points"] == report["accepted"] == 9000
        assert report["digest"] == digest == stored(tmp_path / "map.db").digest()


def test_a_bag_in_parts_gives_the_map_of_the_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = drive()
    whole = build(capsys, write_ros1(tmp_path / "whole.bag", said), "--range-sigma", "0.03")[1]
    # The second part has no /tf_static: it was sent once, at the start.
    parts = [write_ros1(tmp_path / f"{k}.bag", some) for k, some in enumerate((said[:90], said[90:]))]
    report = build(capsys, *parts, "--range-sigma", "0.03")[1]
    assert report["digest"] == whole["digest"]


def test_a_log_of_our_own_gives_its_map_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = live(tmp_path / "logs", drive())
    (log,) = (tmp_path / "logs").glob("*.mcap")
    (tmp_path / "robot.toml").write_text('[sensors.velodyne]\nrange_sigma = 0.03\nextrinsics = "transform"\n')
    code, report, err = build(capsys, log, "-c", "robot.toml")
    assert (code, err) == (0, "")
    assert report["digest"] == run.run.map.digest()
    code, _, err = build(capsys, log, "--range-sigma", "0.03")
    assert code == 2
    assert "[sensors.velodyne]" in err
    assert "roughmap replay" in err


def test_a_cloud_without_poses_around_it_is_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = drive()
    late = [one for one in said if not (one.kind == "odometry" and one.content["stamp_ns"] < T0 + 10**9)]
    _, report, err = build(capsys, write_sqlite(tmp_path / "bag", late), "--range-sigma", "0.03")
    clouds = report["clouds"]
    assert isinstance(clouds, dict)
    assert clouds["integrated"] >= 18
    assert clouds["no_pose"] + clouds["integrated"] == 30
    assert report["rejected"] == {"no_pose": 300 * clouds["no_pose"]}
    assert err == ""


def test_clouds_without_extrinsics_are_said_with_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = [one for one in drive() if one.kind != "tf"]
    code, report, err = build(capsys, write_sqlite(tmp_path / "bag", said), "--range-sigma", "0.03")
    assert code == 0
    assert report["clouds"] == {"no_extrinsics": 30}
    last = err.strip().splitlines()[-1]
    assert last.startswith("roughmap: warning: 30 of 30 clouds were rejected as no_extrinsics")
    assert "[sensors.velodyne]" in last


def test_poses_in_a_frame_of_their_own_are_mapped_in_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, report, err = build(capsys, write_sqlite(tmp_path / "bag", drive(frame="odom")), "--range-sigma", "0.03")
    assert code == 0
    assert report["clouds"] == {"integrated": 30}
    assert "its poses are mapped in 'odom'" in err
    assert err.count("\n") == 1


def test_a_trajectory_beside_a_bag_gives_its_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clouds = [one for one in drive() if one.kind == "cloud"]
    lines = [f"{one.log_ns / 1e9:.4f} {0.08 * k:.4f} 0 1 0 0 0 1" for k, one in enumerate(clouds)]
    (tmp_path / "traj.txt").write_text("\n".join(lines))
    bag = write_sqlite(tmp_path / "bag", clouds)
    assert build(capsys, bag, "--range-sigma", "0.03")[0] == 2
    code, report, _ = build(capsys, bag, "--range-sigma", "0.03", "--poses", "traj.txt")
    assert code == 0
    # The points of a cloud are from before its stamp: the first cloud has no pose before it.
    assert report["clouds"] == {"no_pose": 1, "integrated": 29}


def test_an_interrupt_leaves_the_map_of_what_was_read(tmp_path: Path) -> None:
    said = drive()
    bag = write_sqlite(tmp_path / "bag", said)
    stop, config = threading.Event(), Config()
    seen: list[Progress] = []

    def watch(progress: Progress, _map: object) -> None:
        seen.append(progress)
        if progress.points > 3000 and not stop.is_set():
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with interrupting(stop):
        built = build_map([bag], config, ReadOptions(), Wanted(range_sigma=0.03), watch, stop)
    assert built.interrupted
    assert signal.getsignal(signal.SIGINT) is before
    assert 8 <= built.clouds["integrated"] <= 12
    assert built.points == built.accepted == 300 * built.clouds["integrated"]
    part = [one for one in said if one.log_ns <= said[-1].log_ns][: len(seen) + 40]
    shares = [progress.share for progress in seen]
    assert shares == sorted(shares)
    assert 0 < shares[-1] < 0.6
    assert len(part) < len(said)


def test_the_command_writes_what_was_read_and_ends_with_130(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from roughmap_service.offline import building

    bag = write_sqlite(tmp_path / "bag", drive())
    take = building.MessageRun.take

    def interrupted(self: building.MessageRun, message: building.RobotMessage) -> None:
        take(self, message)
        if self.counts.clouds["integrated"] == 10:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(building.MessageRun, "take", interrupted)
    code, report, err = build(capsys, bag, "--range-sigma", "0.03")
    assert code == 130
    assert report["interrupted"] is True
    assert report["clouds"] == {"integrated": 10}
    assert "interrupted; map.db holds what was read until then" in err
    assert stored(tmp_path / "map.db").digest() == report["digest"]


def test_a_second_drive_begins_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    early = write_sqlite(tmp_path / "early", drive())
    later = write_ros1(tmp_path / "later.bag", [_moved(one, 3600 * 10**9) for one in drive()])
    report = build(capsys, later, early, "--range-sigma", "0.03")[1]
    assert report["clouds"] == {"integrated": 60}
    assert report["poses"] == {"taken": 320}


def _moved(one: Said, ns: int) -> Said:
    content = {**one.content, "stamp_ns": one.content["stamp_ns"] + ns}
    return one._replace(log_ns=one.log_ns + ns, content=content)


def test_a_recorded_time_that_goes_back_ends_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    said = drive()
    # Of a bag that says it began later than its first messages.
    bag = write_sqlite(tmp_path / "bag", [*said[5:], *said[:5]])
    assert build(capsys, bag, "--range-sigma", "0.03")[1]["clouds"] == {"integrated": 30}


def test_nothing_is_written_if_a_bag_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_ros1(tmp_path / "a.bag", drive())
    with closing(bag.open("r+b")) as file:
        file.truncate(20_000)
    code, _, err = build(capsys, bag, "--range-sigma", "0.03")
    assert code == 2
    assert "damaged at offset" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "map.db").exists()


@pytest.mark.parametrize("reason", CloudReason)
def test_every_reason_has_a_remedy(reason: CloudReason) -> None:
    counts = Counts(clouds=Counter({str(reason): 3}), poses=Counter({TAKEN: 9}))
    line = why_unmapped(counts, Config(), "robot", {"lidar"})
    assert line is not None
    assert line.startswith(f"3 of 3 clouds were rejected as {reason} (")
    assert "; " in line
    assert "{" not in line
