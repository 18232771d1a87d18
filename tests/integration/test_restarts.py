"""Restarts: the same map goes on, by the log alone and by store and log; and what begins another run."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import GROUND, T0, Feed, Service, connected, events_in, replay

from roughmap_schemas import CheckpointEvent, IntegrationEvent
from roughmap_service.store.map_db import Store

S = 10**9


def settings(directory: Path, store: bool, **more: dict[str, Any]) -> dict[str, Any]:
    """Clouds wait long enough to be still undecided at the end; the log goes over several files."""
    sections: dict[str, Any] = {
        "input": {"max_wait": 600.0},
        "log": {"directory": str(directory / "log")},
        "sensors": {"lidar": {"range_sigma": 0.01}, "second": {"range_sigma": 0.01}},
        **more,
    }
    if store:
        sections["store"] = {"path": str(directory / "map.db")}
    return sections


def drive(feed: Feed, begin: int, clouds: int) -> list[int]:
    """Poses at 10 Hz and a cloud between each two of them; the clouds' inputs."""
    numbers = []
    for n in range(begin, begin + clouds):
        for pose in (n, n + 1):
            feed.pose("r1", T0 + pose * S // 10, (0.5 * pose, 0.1 * pose, 1.0))
        numbers.append(feed.cloud("r1", T0 + n * S // 10 + S // 20, np.repeat(GROUND, 50, axis=0)))
    return numbers


def map_digest(feed: Feed) -> dict[tuple[int, int, int], str | None]:
    """Each level-0 tile's digest, as the service tells it."""
    return {tile.key: tile.info.digest for tile in feed.client.tiles()}


@pytest.mark.parametrize("store", [False, True], ids=["by the log", "by the store"])
def test_the_same_map_goes_on(tmp_path: Path, store: bool) -> None:
    sections = settings(tmp_path, store)
    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            decided = [feed.decided(n) for n in drive(feed, 0, 8)]
            undecided = feed.cloud("r1", T0 + 2 * S)
            before, tiles = feed.settle(), map_digest(feed)
        assert service.stop() == 0
        assert before.clouds.waiting == 1
        assert before.sequence == decided[-1].sequence == 8
    if store:
        cut = Store(tmp_path / "map.db").read_cut()
        assert cut is not None
        assert (cut.sequence, cut.input, cut.low_water) == (8, before.input, undecided), "the end took a snapshot"

    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            after = feed.client.status()
            assert map_digest(feed) == tiles
            assert (after.run, after.epoch, after.sequence) == (before.run, before.epoch + 1, before.sequence)
            assert after.instance != before.instance
            assert (after.input, after.clouds.waiting) == (before.input, 1), "it waits again"
            for tenth in (18, 19, 21):  # after a gap it takes three
                feed.pose("r1", T0 + tenth * S // 10, (0.5 * tenth, 0.1 * tenth, 1.0))
            event = feed.decided(undecided)
            assert (event.outcome, event.sequence) == ("integrated", before.sequence + 1)
            # The poses of the first start are still there: this cloud lies before all that the second was told.
            early = feed.decided(feed.cloud("r1", T0 + 4 * S // 10, GROUND + 0.1, "second"))
            assert (early.outcome, early.sequence) == ("integrated", before.sequence + 2)
            last = map_digest(feed)
        assert service.stop() == 0
        first = next(event for event in events_in(service.log) if event.epoch == before.epoch + 1)
        assert isinstance(first, CheckpointEvent), "the log says what the restart brought back, so that replay sees it"
        assert first.sequence == before.sequence
        code, verdict = replay(service.log)
        assert code == 0
        assert ", sequence 10, digest " in verdict

    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            assert map_digest(feed) == last
            assert feed.client.status().epoch == before.epoch + 2
        assert service.stop() == 0


def test_clouds_that_wait_in_vain_end_after_the_restart(tmp_path: Path) -> None:
    with Service(tmp_path, **settings(tmp_path, True)) as service:
        with connected(service) as feed:
            number = feed.cloud("r2", T0)
            feed.decided(drive(feed, 0, 1)[0])
        assert service.stop() == 0
    with Service(tmp_path, **settings(tmp_path, True, input={"max_wait": 0.2})) as service:
        with connected(service) as feed:
            status = feed.settle()
            for _ in range(1000):  # its event may have come before anyone could hear it; each look is an answer
                if status.clouds.rejected:
                    break
                status = feed.settle()
            assert {str(k): n for k, n in status.clouds.rejected.items()} == {"no_pose": 1}
        assert service.stop() == 0
        outcomes = {e.input: e.outcome for e in events_in(service.log) if isinstance(e, IntegrationEvent)}
        assert outcomes[number] == "no_pose"
        assert replay(service.log)[0] == 0


def test_a_lost_store_is_made_again_from_the_log(tmp_path: Path) -> None:
    sections = settings(tmp_path, True)
    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            feed.decided(drive(feed, 0, 3)[-1])
            tiles = map_digest(feed)
        assert service.stop() == 0
    (tmp_path / "map.db").unlink()
    with Service(tmp_path, **sections) as service:
        with connected(service) as feed:
            assert map_digest(feed) == tiles
            assert feed.client.status().sequence == 3
        assert service.stop() == 0
    cut = Store(tmp_path / "map.db").read_cut()
    assert cut is not None
    assert cut.sequence == 3


@pytest.mark.parametrize(
    ("store", "section", "said"),
    [
        (False, {"cell_size": 0.2}, ["map.cell_size", "0.2", "0.1"]),
        (True, {"error_model": "point"}, ["map.error_model", "'point'", "'cuboid'"]),
        (True, {"name": "yard"}, ["name", "'yard'", "'site'"]),
    ],
)
def test_another_identity_is_refused(tmp_path: Path, store: bool, section: dict[str, Any], said: list[str]) -> None:
    with Service(tmp_path, **settings(tmp_path, store)) as service:
        with connected(service) as feed:
            feed.decided(drive(feed, 0, 1)[0])
        assert service.stop() == 0
    there = {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.mcap"))}
    with Service(tmp_path, **settings(tmp_path, store, map=section)) as service:
        assert service.finished(60.0) == 2
        (line,) = [line for line in service.err if line.startswith("roughmap: ")]
        for part in [*said, "--fresh"]:
            assert part in line
    assert {path: path.read_bytes() for path in sorted(tmp_path.rglob("*.mcap"))} == there, "nothing was touched"


def test_fresh_begins_a_new_run(tmp_path: Path) -> None:
    """With another cell size, which would be refused otherwise; the old run's store and log stay beside the new."""
    with Service(tmp_path, **settings(tmp_path, True)) as service:
        with connected(service) as feed:
            feed.decided(drive(feed, 0, 2)[-1])
            old = feed.client.status()
        assert service.stop() == 0
    stored = Store(tmp_path / "map.db").read_cut()
    logs = {path: path.read_bytes() for path in service.log.glob("*.mcap")}
    with Service(tmp_path, "--fresh", **settings(tmp_path, True, map={"cell_size": 0.2})) as service:
        with connected(service) as feed:
            status = feed.client.status()
            assert (status.sequence, status.epoch, status.cell_size) == (0, 1, 0.2)
            assert status.run != old.run
            assert re.fullmatch("[0-9a-f]{32}", status.run)
            assert feed.client.tiles() == []
            assert feed.decided(drive(feed, 0, 1)[0]).sequence == 1
        assert service.stop() == 0
        assert Store(tmp_path / f"map.db.{old.run}").read_cut() == stored
        for path, content in logs.items():
            assert path.read_bytes() == content
        code, said = replay(service.log)
        assert (code, "runs" in said) == (2, True), "one run at a time"
        assert replay(*sorted(service.log.glob(f"*{status.run}*.mcap")))[0] == 0
    with Service(tmp_path, **settings(tmp_path, True, map={"cell_size": 0.2})) as service:
        with connected(service) as feed:
            assert (feed.client.status().run, feed.client.status().sequence) == (status.run, 1), "the new run goes on"
        assert service.stop() == 0


def test_other_settings_change_at_a_restart(tmp_path: Path) -> None:
    """A log over two settings of a sensor replays as equal: each event with the settings of its file."""
    for sigma in (0.01, 0.05):
        with Service(tmp_path, **settings(tmp_path, False, sensors={"lidar": {"range_sigma": sigma}})) as service:
            with connected(service) as feed:
                assert feed.decided(drive(feed, round(sigma * 1000), 2)[-1]).outcome == "integrated"
            assert service.stop() == 0
    code, verdict = replay(service.log)
    assert code == 0
    assert ", sequence 4, digest " in verdict
