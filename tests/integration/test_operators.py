"""What operators and watchers see: snapshots, resets, epochs, updates, gaps, the status."""

import itertools
import sqlite3
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from net import Gathered, wait_until
from processes import GROUND, LEVEL, PRECISE, T0, Feed, Service, connected, events_in, replay, running

from roughmap_client import QueryRefused, Tile
from roughmap_client.session import ask
from roughmap_schemas import ControlAnswer, ForgetEvent, MapStatus, ResetEvent, encode_odometry
from roughmap_service.store.map_db import Store

S = 10**9

Running = tuple[Service, Feed]

NUMBER = itertools.count()


def control(feed: Feed, action: str) -> ControlAnswer:
    part = ask(feed.session, f"maps/site/control/{action}", timeout=30.0).single()
    return ControlAnswer.model_validate_json(part.payload)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A store that is written when it is asked for, and at the end."""
    directory = tmp_path_factory.mktemp("operators")
    store = {"path": str(directory / "map.db"), "snapshot_interval": 3600.0}
    with running(directory, store=store, updates={"update_hz": 20.0}) as both:
        yield both


def grow(feed: Feed, place: float) -> int:
    """A cloud of four points ahead of (place, 0), unlike any before; the sequence that it makes."""
    return feed.decided(feed.cloud("r1", T0 + next(NUMBER), GROUND + np.array([place, 0.0, 0.0]), "map")).sequence


def test_a_snapshot_holds_the_map_as_it_is(both: Running) -> None:
    service, feed = both
    sequence = grow(feed, 0.0)
    answer = control(feed, "snapshot")
    assert (answer.sequence, answer.epoch) == (sequence, feed.client.status().epoch)
    store = Store(service.directory / "map.db")
    cut = store.read_cut()
    assert cut is not None
    assert (cut.sequence, cut.input) == (sequence, feed.client.status().input)
    assert {(0, t.tx, t.ty): t.digest.hex() for t in store.read_tiles()} == {
        tile.key: tile.info.digest for tile in feed.client.tiles()
    }
    assert feed.client.status().durable_sequence >= sequence


def test_a_snapshot_without_a_store_is_refused(tmp_path: Path) -> None:
    with Service(tmp_path) as service, connected(service) as feed:
        with pytest.raises(QueryRefused, match=r"store\.path"):
            control(feed, "snapshot")
        assert service.stop() == 0


@pytest.mark.parametrize("key", ["maps/site/control/*", "maps/site/**", "maps/*/control/reset"])
def test_looking_around_resets_nothing(both: Running, key: str) -> None:
    _, feed = both
    before = feed.client.status()
    ask(feed.session, key, timeout=30.0)
    after = feed.client.status()
    assert (after.epoch, after.sequence) == (before.epoch, before.sequence)


def test_a_reset(both: Running) -> None:
    """A new epoch, an event, an empty map; who asks since an older version is told which tiles are gone."""
    service, feed = both
    grow(feed, 100.0)
    before = feed.client.changes()
    assert before.complete
    assert before.tiles
    answer = control(feed, "reset")
    assert (answer.epoch, answer.sequence) == (before.version.epoch + 1, before.version.sequence + 1)
    assert feed.client.tiles() == []
    status = feed.client.status()
    assert (status.epoch, status.sequence, status.extent, status.tiles.resident) == (
        answer.epoch, answer.sequence, None, 0,
    )  # fmt: skip
    event = ResetEvent(epoch=answer.epoch, sequence=answer.sequence)
    assert event in events_in(service.log), "durable before the first answer"
    feed.events.wait(lambda events: event in events, "the published reset")
    changes = feed.client.changes(before.version)
    assert changes.complete
    assert [(tile.key, tile.known_cells) for tile in changes.tiles] == [(tile.key, 0) for tile in before.tiles]
    assert grow(feed, 0.0) == answer.sequence + 1


def test_what_an_operator_forgets(tmp_path: Path) -> None:
    """By place, and by age, as events that a replay and a start follow; what is far away or new stays."""
    store = {"path": str(tmp_path / "map.db"), "snapshot_interval": 3600.0}
    with Service(tmp_path, store=store) as service:
        with connected(service) as feed:
            grow(feed, 0.0)
            grow(feed, 100.0)
            control(feed, "snapshot")
            held = feed.client.changes()
            answer = feed.client.forget((90.0, -10.0, 120.0, 10.0))
            assert (answer.sequence, answer.epoch) == (held.version.sequence + 1, held.version.epoch)
            gone = [tile.key for tile in feed.client.changes(held.version).tiles if not tile.known_cells]
            assert (answer.tiles, all(x > 10 for _, x, _ in gone)) == (len(gone), True)
            event = ForgetEvent(epoch=answer.epoch, sequence=answer.sequence, tiles=[key[1:] for key in sorted(gone)])
            feed.events.wait(lambda events: event in events, "the published event")
            feed.decided(feed.cloud("r1", T0 + 60 * S, GROUND + np.array([-100.0, 0.0, 0.0]), "map"))
            assert feed.client.forget(older=3600.0).tiles == 0
            old = feed.client.forget(older=30.0)
            assert old.sequence == answer.sequence + 2
            tiles = {tile.key: tile.info.digest for tile in feed.client.tiles()}
            assert all(x < -10 for _, x, _ in tiles)
            assert tiles
            assert feed.client.status().forgotten == answer.tiles + old.tiles
            wait_until(lambda: feed.client.status().durable_sequence >= old.sequence, "the log of what was forgotten")
            service.line('"event": "tiles_forgotten"')
        service.kill()  # so that the store is still the one before
    with Service(tmp_path, store=store) as service:
        with connected(service) as feed:
            assert {tile.key: tile.info.digest for tile in feed.client.tiles()} == tiles
        assert service.stop() == 0
    assert replay(service.log)[0] == 0
    assert {(0, tile.tx, tile.ty) for tile in Store(tmp_path / "map.db").read_tiles()} == tiles.keys()


def test_a_reset_holds_after_a_restart(tmp_path: Path) -> None:
    store = {"path": str(tmp_path / "map.db"), "snapshot_interval": 3600.0}
    with Service(tmp_path, store=store) as service:
        with connected(service) as feed:
            grow(feed, 0.0)
            control(feed, "snapshot")
            epoch = control(feed, "reset").epoch
            grow(feed, 200.0)
            tiles = {tile.key: tile.info.digest for tile in feed.client.tiles()}
        service.kill()  # so that the store is still the one before the reset
    with Service(tmp_path, store=store) as service:
        with connected(service) as feed:
            assert {tile.key: tile.info.digest for tile in feed.client.tiles()} == tiles
            status = feed.client.status()
            assert (status.sequence, status.epoch) == (3, epoch + 1)
        assert service.stop() == 0
    assert replay(service.log)[0] == 0
    with sqlite3.connect(tmp_path / "map.db") as db:
        stored = db.execute("SELECT tx, ty FROM tiles").fetchall()
    db.close()
    assert set(stored) == {key[1:] for key in tiles}, "tiles from before the reset are gone from the store too"


def test_changes_since_a_version(both: Running) -> None:
    _, feed = both
    grow(feed, 0.0)
    held = feed.client.changes().version
    assert feed.client.changes(held).tiles == []
    sequence = grow(feed, 300.0)
    changes = feed.client.changes(held)
    assert not changes.complete
    assert {tile.key for tile in changes.tiles} == {(0, 47, -1), (0, 47, 0)}
    assert changes.version.sequence == sequence


def test_updates_show_the_tiles_of_a_scan(both: Running) -> None:
    """What is published is what a query would answer: the same cells, the same digest."""
    _, feed = both
    seen: Gathered[Tile] = Gathered()
    with feed.client.watch(seen):
        sequence = grow(feed, 400.0)
        asked = {
            tile.key: tile
            for tile in feed.client.tiles((400.0, -1.0, 403.0, 1.0), ["mean_height", "range", "confidence_factor"])
        }
        assert len(asked) > 1

        def all_there(tiles: list[Tile]) -> bool:
            return {tile.key for tile in tiles if tile.info.sequence == sequence} >= set(asked)

        tiles = {t.key: t for t in seen.wait(all_there, "the tiles of the scan") if t.info.sequence == sequence}
    assert set(tiles) == set(asked), "and of no others"
    for key, tile in tiles.items():
        assert list(tile) == ["mean_height", "range", "confidence_factor"]
        for layer in tile:
            np.testing.assert_array_equal(tile[layer], asked[key][layer])
        assert tile.info.digest == asked[key].info.digest
        assert tile.epoch == feed.client.status().epoch


def test_gaps_in_message_numbers(both: Running) -> None:
    _, feed = both
    before = feed.settle().refused.get("bad_message", 0)  # type: ignore[call-overload]
    for number in range(3, 12):
        pose = encode_odometry(T0 + number * S // 10, "map", (0, 0, 0), LEVEL, PRECISE)
        feed.put("odometry", "lossy", pose, attachment=number.to_bytes(8, "little"))
    feed.put("odometry", "lossy", b"no pose, but it has a number", attachment=(14).to_bytes(8, "little"))
    status = feed.settle()
    assert status.gaps == {"lossy": 2}
    assert status.refused["bad_message"] == before + 1  # type: ignore[index]


def test_the_status_is_published_and_asked_for(both: Running) -> None:
    service, feed = both
    grow(feed, 500.0)
    published: Gathered[tuple[str, MapStatus]] = Gathered()

    def take(sample: zenoh.Sample) -> None:
        published((str(sample.encoding), MapStatus.model_validate_json(sample.payload.to_bytes())))

    subscriber = feed.session.declare_subscriber("maps/site/status", take)
    encoding, status = published.wait(lambda items: len(items) >= 1, "a status")[0]
    subscriber.undeclare()
    asked = feed.client.status()
    assert encoding == "application/json;roughmap.MapStatus"
    assert (status.instance, status.run) == (asked.instance, asked.run)
    assert status.instance == service.ready()["instance"]
    assert (asked.health, asked.map, asked.frame_id, asked.cell_size) == ("ok", "site", "map", 0.1)
    assert asked.clouds.accepted > 0
    assert asked.points.accepted == 4 * asked.clouds.accepted
    assert asked.lag_s.p50 is not None
    assert 0 < asked.lag_s.p50 <= asked.lag_s.p99  # type: ignore[operator]
    assert asked.rates.clouds > 0
    assert asked.memory_bytes > 10**7
    assert asked.log.ok
    assert Path(asked.log.file or "").parent == service.log
    assert 0 < asked.uptime_s < 600
