"""Killed in mid-drive: what was acknowledged is there again, and the map is what the surviving log makes."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net import Gathered
from processes import T0, Service, connected, events_in, inputs_in, replay

from roughmap import RoughMap
from roughmap_schemas import CheckpointEvent, IntegrationEvent, Receipt, decode_cloud, encode_cloud

PLACED = np.eye(3) * (0.02 * 0.02)
"""The covariance of a placed point by default: input.placed_sigma^2. All points of a cloud may err by it together."""


def cloud(number: int) -> bytes:
    """Two thousand points in the map's frame around a place that moves with the number."""
    rng = np.random.default_rng(number)
    return encode_cloud(rng.normal([0.1 * number, 0.0, 0.0], [2.0, 2.0, 0.1], (2000, 3)), T0 + number, "map")


def built(log: Path) -> RoughMap:
    """The map that the log's inputs and events make, by the library alone."""
    inputs = [message.data for message in inputs_in(log)]
    rough_map = RoughMap()
    for event in events_in(log):
        if isinstance(event, IntegrationEvent) and event.outcome == "integrated":
            taken = decode_cloud(inputs[event.input - 1], max_message=1 << 20, max_points=1 << 20)
            rough_map.add(taken.points, PLACED, taken.stamp_ns, common=PLACED[2, 2])
    return rough_map


@pytest.mark.parametrize("store", [False, True], ids=["by the log", "by the store"])
def test_killed_in_mid_drive(tmp_path: Path, store: bool) -> None:
    settings: dict[str, Any] = {"log": {"checkpoint_interval": 0.05}}
    if store:
        settings["store"] = {"path": str(tmp_path / "map.db"), "snapshot_interval": 0.1}
    answers: Gathered[tuple[bytes, Receipt | str]] = Gathered()
    with Service(tmp_path, **settings) as service, connected(service) as feed:
        for number in range(600):
            payload = cloud(number)
            feed.send("points", "r1", payload, lambda answer, payload=payload: answers((payload, answer)))  # type: ignore[misc]
            if number == 400:
                answers.wait(lambda items: len(items) >= 200, "200 receipts")
                service.process.kill()
                break
        service.finished()
    receipts = [(payload, answer) for payload, answer in answers.items if isinstance(answer, Receipt)]
    assert len(receipts) >= 200
    before = [message.data for message in inputs_in(service.log)]
    assert all(before[receipt.input - 1] == payload for payload, receipt in receipts)
    (file,) = service.log.glob("*.mcap")
    survived = file.read_bytes()

    with Service(tmp_path, **settings) as service:
        with connected(service) as feed:
            status = feed.settle()
            while status.clouds.waiting:
                status = feed.settle()
            assert status.epoch == 2
            tiles = {tile.key[1:]: tile.info.digest for tile in feed.client.tiles()}
        assert service.stop() == 0
        logged = [message.data for message in inputs_in(service.log)]
        assert logged[: len(before)] == before
        integrated = {e.input for e in events_in(service.log) if isinstance(e, IntegrationEvent) and e.accepted}
        assert {receipt.input for _, receipt in receipts} <= integrated, "what was acknowledged is in the map"
        assert status.sequence == len(integrated)
        code, verdict = replay(service.log)
        assert code == 0, verdict
        rough_map = built(service.log)
        with rough_map.freeze() as frozen:
            assert {key: frozen.digest(*key) for key in tiles} == tiles
        last = [event for event in events_in(service.log) if isinstance(event, CheckpointEvent)][-1]
        assert (last.sequence, last.digest) == (status.sequence, rough_map.digest())
        torn = file.with_name(file.name + ".torn")
        if torn.exists():  # where the kill came within a record: what could not be read is kept beside the log
            assert torn.stat().st_size > 0
            assert survived.endswith(torn.read_bytes())


def test_a_tear_within_a_record(tmp_path: Path) -> None:
    """The file ends within a record, as after a power cut: the rest is kept, and what stood before it is the run."""
    with Service(tmp_path, log={"checkpoint_interval": 0.05}) as service:
        with connected(service) as feed:
            for number in range(5):
                feed.ingest("points", "r1", cloud(number))
            feed.events.wait(
                lambda events: any(isinstance(e, CheckpointEvent) and e.sequence == 5 for e in events), "a checkpoint"
            )
            feed.settle()
        service.kill()
    (file,) = service.log.glob("*.mcap")
    whole = inputs_in(service.log)
    with file.open("ab") as stream:
        stream.write(b"\x06" + (10**6).to_bytes(8, "little") + b"the beginning of a chunk")
    shutil.copytree(service.log, tmp_path / "copy", ignore=shutil.ignore_patterns(".lock"))
    with Service(tmp_path) as service:
        with connected(service) as feed:
            assert feed.client.status().sequence == 5
        assert service.stop() == 0
        assert [m.data for m in inputs_in(service.log)] == [m.data for m in whole]
        torn = file.with_name(file.name + ".torn").read_bytes()
        assert torn.endswith(b"the beginning of a chunk")
        assert replay(service.log)[0] == 0
    assert replay(tmp_path / "copy")[0] == 0, "and a torn log replays as far as it goes"


def test_nothing_is_torn_by_a_kill_between_records(tmp_path: Path) -> None:
    with Service(tmp_path) as service:
        with connected(service) as feed:
            feed.decided(feed.ingest("points", "r1", cloud(1)).input)
            feed.settle()  # all of it is flushed, and nothing else is under way
        service.kill()
    (file,) = service.log.glob("*.mcap")
    before = [message.data for message in inputs_in(service.log)]
    with Service(tmp_path) as service:
        service.ready()
        assert service.stop() == 0
    assert not file.with_name(file.name + ".torn").exists()
    assert [message.data for message in inputs_in(service.log)] == before
    assert replay(service.log)[0] == 0


def test_nothing_is_torn_by_an_orderly_end(tmp_path: Path) -> None:
    for start in range(2):
        with Service(tmp_path) as service:
            with connected(service) as feed:
                feed.decided(feed.ingest("points", "r1", cloud(start)).input)
            assert service.stop() == 0
    assert not list(service.log.glob("*.torn"))
    assert len(list(service.log.glob("*.mcap"))) == 2, "every start begins a file"
