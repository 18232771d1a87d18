"""Several robots at once: one order of the run, the log's, and the same map when it is replayed."""

import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from mcap.reader import make_reader
from mcap.writer import Writer
from processes import COMMAND, PRECISE, T0, Feed, Service, connected, environment, events_in, read_log, replay

from roughmap_schemas import CheckpointEvent, Event, IntegrationEvent, encode_cloud, encode_odometry

S = 10**9
CLOUDS = 15
"""Of each robot."""


@dataclass(frozen=True)
class Drive:
    """What came of two robots that drove over the same ground at the same time."""

    log: Path
    published: list[Event]
    digests: dict[tuple[int, int, int], str | None]


def go(feed: Feed, robot: str, side: float, seed: int) -> None:
    """Sweeps with times of their own, poses at 20 Hz that come after the clouds which need them."""
    rng = np.random.default_rng(seed)
    for n in range(CLOUDS):
        begin = T0 + n * S // 10
        points = rng.uniform((-6, -6, -1.2), (6, 6, -0.8), (3000, 3)).astype(np.float32)
        times = np.sort(rng.integers(0, S // 10, len(points)))
        feed.put("points", robot, encode_cloud(points, begin, "lidar", offsets_ns=times))
        for half in range(3):
            stamp = begin + half * S // 20
            angle = 0.05 * (n + half / 2) * side
            position = (0.2 * (n + half / 2), side, 1.0)
            turned = (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2))
            feed.put("odometry", robot, encode_odometry(stamp, "map", position, turned, PRECISE))


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    directory = tmp_path_factory.mktemp("two")
    with Service(directory, log={"checkpoint_interval": 0.1}) as service:
        with connected(service) as left, connected(service) as right:
            robots = [
                threading.Thread(target=go, args=(left, "left", 1.0, 1)),
                threading.Thread(target=go, args=(right, "right", -1.0, 2)),
            ]
            for robot in robots:
                robot.start()
            for robot in robots:
                robot.join()
            left.wait_integrations(2 * CLOUDS)
            digests = {tile.key: tile.info.digest for tile in left.client.tiles()}
            left.settle()
            published = left.events.items
        assert service.stop() == 0
        yield Drive(service.log, published, digests)


def test_both_are_in_the_map(drive: Drive) -> None:
    events = [e for e in events_in(drive.log) if isinstance(e, IntegrationEvent)]
    for robot in ("left", "right"):
        outcomes = [e.outcome for e in events if e.robot == robot]
        assert outcomes == ["integrated"] * CLOUDS
    assert [e.sequence for e in events] == list(range(1, 2 * CLOUDS + 1))


def test_each_robots_clouds_are_decided_in_order_of_arrival(drive: Drive) -> None:
    for robot in ("left", "right"):
        inputs = [e.input for e in events_in(drive.log) if isinstance(e, IntegrationEvent) and e.robot == robot]
        assert inputs == sorted(inputs)


def test_events_are_published_as_logged_and_in_that_order(drive: Drive) -> None:
    logged = events_in(drive.log)
    start = logged.index(drive.published[0])
    assert logged[start : start + len(drive.published)] == drive.published


def test_an_event_stands_after_all_that_it_names(drive: Drive) -> None:
    seen = 0
    for message in read_log(drive.log):
        if message.topic.startswith("robots/"):
            seen += 1
            assert message.sequence == seen, "inputs are numbered from 1 in file order"
        elif message.topic.endswith("/events") and isinstance(event := message.event, IntegrationEvent):
            named = [event.input, *(pose for pose, _ in event.poses), *(t for _, t in event.poses)]
            assert max(named) <= seen


def test_replay_comes_to_the_same_digest(drive: Drive) -> None:
    """In another process, whose map begins empty; its word is the last checkpoint's, taken while it was live."""
    last = [event for event in events_in(drive.log) if isinstance(event, CheckpointEvent)][-1]
    done = subprocess.run(
        [*COMMAND, "replay", str(drive.log)], check=False, capture_output=True, text=True, env=environment()
    )
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()[-1]
    assert said.startswith("equal: ")
    assert said.endswith(f" checkpoints, sequence {2 * CLOUDS}, digest {last.digest}")


def test_the_tiles_that_were_served_are_those_of_the_replay(drive: Drive, tmp_path: Path) -> None:
    from roughmap_service.store.map_db import Store

    code, _ = replay(drive.log, "-o", tmp_path / "map.db")
    assert code == 0
    stored = {(0, tile.tx, tile.ty): tile.digest.hex() for tile in Store(tmp_path / "map.db").read_tiles()}
    assert stored == drive.digests


def rewritten(log: Path, to: Path, *, moved: int | None = None, dropped: int | None = None) -> Path:
    """The log again, by mcap's own reader and writer, but with a point of input ``moved`` shifted by 1 mm, or without
    input ``dropped``."""
    (file,) = log.glob("*.mcap")
    to.mkdir()
    with file.open("rb") as source, (to / file.name).open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start(profile="roughmap")
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in channels:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            data = message.data
            is_input = channel.topic.startswith("robots/")
            if is_input and message.sequence == dropped:
                continue
            if is_input and message.sequence == moved:
                cloud = PointCloud.FromString(data)
                z = np.frombuffer(cloud.data, "<f4")[2] + np.float32(1e-3)
                cloud.data = cloud.data[:8] + np.float32(z).tobytes() + cloud.data[12:]
                data = cloud.SerializeToString()
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()
    return to


def cloud_of_event(log: Path, number: int) -> int:
    """The input of the cloud that made that version of the map."""
    return next(e.input for e in events_in(log) if isinstance(e, IntegrationEvent) and e.sequence == number)


def test_rewriting_alone_changes_nothing(drive: Drive, tmp_path: Path) -> None:
    """So that what the next tests find is their change."""
    code, said = replay(rewritten(drive.log, tmp_path / "same"))
    assert (code, said.split(":")[0]) == (0, "equal")


@pytest.mark.parametrize("version", [1, 2 * CLOUDS])
def test_one_point_moved_by_a_millimetre_differs(drive: Drive, tmp_path: Path, version: int) -> None:
    code, said = replay(rewritten(drive.log, tmp_path / "moved", moved=cloud_of_event(drive.log, version)))
    assert code == 1
    assert said.startswith("differs at sequence ")
    found = int(said.split()[3].rstrip(":,"))
    assert found >= version, "at the first checkpoint that saw it"


def test_an_input_missing_is_noticed(drive: Drive, tmp_path: Path) -> None:
    code, _ = replay(rewritten(drive.log, tmp_path / "short", dropped=cloud_of_event(drive.log, 5)))
    assert code != 0
