"""Tiles as they are published: to those who listen, the last change always."""

from typing import Any

import numpy as np
import pytest
import zenoh
from asking_raw import RawTile
from net import Gathered
from served import Served, some_points

from roughmap_schemas.messages import UpdateRecord, parse_model
from roughmap_service.answers import updates
from roughmap_service.answers.drawing import TileForm, TileList


def layers_of(served: Served, tile: RawTile) -> bool:
    """Whether an update shows the map as it is now."""
    z, x, y = tile.key
    with served.map.freeze(z) as frozen:
        return bool(tile.info["digest"] == frozen.digest(x, y))


@pytest.mark.parametrize("level", [0, 1])
def test_the_last_change_always_comes(level: int) -> None:
    heard: Gathered[zenoh.Sample] = Gathered()
    settings: dict[str, Any] = {"updates": {"levels": [0, 1], "update_hz": 50.0, "layers": ["mean_height", "count"]}}
    with Served(settings) as served, served.updates():
        subscriber = served.asker.declare_subscriber(f"maps/site/updates/{level}/*/*", heard)
        for seed in range(20):
            served.add(some_points(200, seed, (0.5 * seed, 0.0)))
        last = served.map.sequence

        def complete(samples: list[zenoh.Sample]) -> bool:
            newest = {tile.key: tile for tile in map(RawTile, samples)}
            with served.map.freeze(level) as frozen:
                changed = frozen.tiles[frozen.sequences > 5].tolist()  # 5: the map as it was before
            return all((level, x, y) in newest and layers_of(served, newest[level, x, y]) for x, y in changed)

        samples = heard.wait(complete, "the last state of every changed tile")
        subscriber.undeclare()
        tiles = [RawTile(sample) for sample in samples]
        assert max(tile.info["map_sequence"] for tile in tiles) == last
        for tile in tiles:
            z, x, y = tile.key
            assert z == level
            assert tile.name == f"maps/site/updates/{z}/{x}/{y}"
            assert list(tile.layers()) == ["mean_height", "count"]
            assert np.count_nonzero(tile.layers()["count"]) == tile.info["known_cells"]


def test_nothing_is_made_while_nobody_listens() -> None:
    made: list[str] = []
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served({"updates": {"update_hz": 50.0}}) as served:
        with served.updates(lambda kind, *_: made.append(kind)):
            for seed in range(5):
                served.add(some_points(100, seed))
        assert made == [], "all rounds are over, and nobody had listened"
        with served.updates(lambda kind, *_: made.append(kind)):
            subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
            served.add(some_points(100, 9))
            heard.wait(bool, "an update")
            subscriber.undeclare()
        assert made


@pytest.mark.parametrize("mode", ["records", "grids", "none"])
def test_what_the_log_keeps(mode: str) -> None:
    kept: Gathered[tuple[str, bytes, int]] = Gathered()
    heard: Gathered[zenoh.Sample] = Gathered()
    settings: dict[str, Any] = {"log": {"updates": mode}, "updates": {"update_hz": 50.0}}
    with Served(settings) as served, served.updates(lambda *record: kept(record)):
        subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
        served.add(some_points(100, 9))
        heard.wait(lambda samples: len(samples) >= 4, "the four tiles around the origin")
        subscriber.undeclare()
        came = heard.items
        if mode != "none":
            kept.wait(lambda records: len(records) >= len(came), "their records")
    assert {kind for kind, _, _ in kept.items} == {"records": {"updates"}, "grids": {"grids"}, "none": set()}[mode]
    if mode == "records":
        records = [parse_model(UpdateRecord, payload) for _, payload, _ in kept.items]
        assert [record.info.newest_ns for record in records] == [stamp_ns for _, _, stamp_ns in kept.items]
        assert {str(sample.key_expr) for sample in came} <= {record.key for record in records}
    if mode == "grids":
        assert {sample.payload.to_bytes() for sample in came} <= {payload for _, payload, _ in kept.items}


def test_a_tile_that_was_published_is_not_drawn_again() -> None:
    """A query for the same layers gets the very same bytes, without a look at the map's cells."""
    heard: Gathered[zenoh.Sample] = Gathered()
    settings: dict[str, Any] = {"updates": {"update_hz": 50.0, "layers": ["mean_height", "count"]}}
    with Served(settings) as served, served.updates():
        subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
        sequence = served.add(some_points(100, 9))
        samples = heard.wait(lambda samples: len(samples) >= 4, "the four tiles around the origin")
        subscriber.undeclare()
        tiles, sequences = served.map.tile_sequences(0)
        listed = TileList(0, served.reader.cell_size, sequence, served.map.newest_updated, tiles, sequences)
        form = TileForm(("mean_height", "count"), served.reader.tolerance, served.reader.limits)
        drawing = served.reader.drawing(listed, served.epoch, form)
        for sample in samples:
            info = RawTile(sample).info
            assert drawing.tile(info["x"], info["y"], info["sequence"]).payload == sample.payload.to_bytes()


def test_what_a_reset_emptied_is_published_once() -> None:
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served({"updates": {"update_hz": 50.0}}) as served, served.updates():
        subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
        served.add(some_points(100, 9))
        heard.wait(bool, "an update: the listener is known")
        with served.map.freeze() as frozen:
            known = {(0, x, y) for x, y in frozen.tiles.tolist()}
        served.reset()

        def gone(samples: list[zenoh.Sample]) -> set[tuple[int, int, int]]:
            return {tile.key for tile in map(RawTile, samples) if tile.info["known_cells"] == 0}

        heard.wait(lambda samples: gone(samples) == known, "every tile that is gone")
        served.add(some_points(100, 10))
        heard.wait(lambda samples: RawTile(samples[-1]).info["known_cells"] > 0, "what came after")
        subscriber.undeclare()
        emptied = [tile.key for tile in map(RawTile, heard.items) if tile.info["known_cells"] == 0]
        assert len(emptied) == len(set(emptied))


def test_what_was_forgotten_is_published_once() -> None:
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served({"updates": {"update_hz": 50.0}}) as served, served.updates():
        subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
        served.add(some_points(100, 9))
        heard.wait(bool, "an update: the listener is known")
        sequence, epoch, number = served.forget((-2, -1, -1, 0), None, "")

        def gone(samples: list[zenoh.Sample]) -> list[RawTile]:
            return [tile for tile in map(RawTile, samples) if tile.info["known_cells"] == 0]

        heard.wait(lambda samples: len(gone(samples)) >= number, "every tile that is gone")
        served.add(some_points(100, 10, (40.0, 0.0)))
        heard.wait(lambda samples: RawTile(samples[-1]).info["map_sequence"] > sequence, "what came after")
        subscriber.undeclare()
    told = gone(heard.items)
    assert sorted(tile.key for tile in told) == sorted((0, x, y) for x in (-2, -1) for y in (-1, 0))
    assert {tile.info["epoch"] for tile in told} == {epoch}


def test_a_round_holds_only_what_changed() -> None:
    """All other tiles may leave memory while updates are being published, and no scan has to copy them."""
    heard: Gathered[zenoh.Sample] = Gathered()
    held: Gathered[set[tuple[int, int]]] = Gathered()
    with Served({"updates": {"update_hz": 50.0}}) as served:

        def look(*_: object) -> None:  # in the midst of a round, where its listener might stall
            with served.view.reading() as m:
                table = m._table
                base, pinned = table.levels[0], table.pool.pins[table.slot[: table.size]] > 0
                entries = np.flatnonzero(pinned)
                held(set(zip(base.tx[entries].tolist(), base.ty[entries].tolist(), strict=True)))

        far = [(6.4 * x + 0.05, 6.4 * y + 0.05, 0.0) for x in range(-30, 30) for y in range(-30, 30)]
        served.map.add(np.array(far), np.eye(3) * 1e-6)
        with served.updates(look):
            subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
            ends = np.array([(-128.0 + 3.2, 3.2, 0.0), (128.0 + 3.2, 3.2, 0.0)])
            with served.view.change():
                served.map.add(ends, np.eye(3) * 1e-6)
            held.wait(lambda looks: len(looks) >= 2, "both updates")
            subscriber.undeclare()
    for tiles in held.items:
        assert tiles == {(x + dx, dy) for x in (-20, 20) for dx in (-1, 0, 1) for dy in (-1, 0, 1)}


def test_one_tile_at_most_so_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """However many scans come between two rounds, which are a quarter of an hour apart here, or the last round and the
    end: they make one update a tile."""
    # So that the first round is of the first scan, however slow this is.
    monkeypatch.setattr(updates, "BACK_SECONDS", 3600.0)
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served({"updates": {"update_hz": 0.001}}) as served:
        with served.updates():
            first = served.add(some_points(100, 1))
            subscriber = served.asker.declare_subscriber("maps/site/updates/0/0/0", heard)
            heard.wait(bool, "the first update")
            for seed in range(30):
                last = served.add(some_points(50, seed))
        samples = heard.wait(lambda got: RawTile(got[-1]).info["map_sequence"] == last, "the last one")
        subscriber.undeclare()
    assert [RawTile(sample).info["map_sequence"] for sample in samples] == [first, last]
