"""Tiles as they change, handed to a callback."""

import logging
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
from foreign import Pair, grid, info
from net import WAIT_S, Gathered, open_pair, wait_for
from served import Served

from roughmap_client import RoughMapClient, RoughMapError, Tile, UnreadableAnswer
from roughmap_schemas import TileInfo, model_bytes
from roughmap_schemas.encodings import GRID


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A pair for each test: no subscriber of the test before is still known."""
    with open_pair() as pair:
        yield pair


@pytest.fixture
def client(pair: Pair) -> Iterator[RoughMapClient]:
    with RoughMapClient("site", session=pair[1], timeout=WAIT_S) as client:
        yield client


class Publishing:
    """Puts updates as a service does; `heard` waits until somebody subscribes."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session
        self.publisher = session.declare_publisher("maps/site/updates/0/*/*")
        self.there = threading.Event()
        self.publisher.declare_matching_listener(lambda status: self.there.set() if status.matching else None)
        if getattr(self.publisher.matching_status, "matching", self.publisher.matching_status):
            self.there.set()

    def heard(self) -> "Publishing":
        wait_for(self.there, "a subscriber")
        return self

    def put(self, tile: TileInfo, value: float = 1.0, payload: bytes | None = None) -> None:
        self.session.put(
            f"maps/site/updates/0/{tile.x}/{tile.y}",
            grid(value=value) if payload is None else payload,
            encoding=GRID,
            attachment=model_bytes(tile),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


@pytest.fixture
def publishing(pair: Pair) -> Iterator[Publishing]:
    made = Publishing(pair[0])
    yield made
    made.publisher.undeclare()


def test_the_tiles_that_change_come(pair: Pair) -> None:
    """From the service's own updates, as the map has them; another level is not heard."""
    tiles: Gathered[Tile] = Gathered()
    settings = {"updates": {"layers": ["mean_height", "count"], "levels": [0, 1], "update_hz": 50.0}}
    with Served(settings=settings, sessions=pair) as served:
        record = Gathered[object]()
        with (
            served.updates(lambda *told: record(told)),
            RoughMapClient("site", session=served.asker, timeout=WAIT_S) as client,
            client.watch(tiles, level=1),
        ):  # fmt: skip
            # What is added before the subscription is noticed comes too, once it is: the service looks back.
            sequence = served.add(np.array([[200.3, 100.2, 4.5], [200.3, 100.2, 4.5]]))
            tiles.wait(lambda items: any(tile.key == (1, 15, 7) for tile in items), "the tile")
    (tile,) = [tile for tile in tiles.items if tile.key == (1, 15, 7)]
    assert {tile.key[0] for tile in tiles.items} == {1}
    assert list(tile) == ["mean_height", "count"]
    assert tile.sequence == sequence == tile.info.sequence
    assert tile.known_cells == np.count_nonzero(tile["count"]) > 0
    assert set(tile["mean_height"][tile["count"] > 0]) == {4.5}


def test_while_the_callback_is_busy_the_newest_state_waits(client: RoughMapClient, publishing: Publishing) -> None:
    entered, go_on = threading.Event(), threading.Event()
    seen: Gathered[tuple[int, float]] = Gathered()

    def callback(tile: Tile) -> None:
        seen((tile.key[1], float(tile["mean_height"][0, 0])))
        entered.set()
        wait_for(go_on, "leave to go on")

    # Samples of one session come in order: when a second watch has the one after the last, the first has them all.
    other: Gathered[int] = Gathered()
    with client.watch(lambda tile: other(tile.key[1])), client.watch(callback):
        publishing.heard().put(info(0), 1.0)
        wait_for(entered, "the first tile")
        for value in (2.0, 3.0, 4.0):
            publishing.put(info(1), value)
            publishing.put(info(2), value + 10)
        publishing.put(info(3), 5.0)
        publishing.put(info(4), 6.0)
        other.wait(lambda items: 4 in items, "the tile after the last, by a second watch")
        go_on.set()
        seen.wait(lambda items: len(items) >= 5, "the tiles that waited")
    assert seen.items == [(0, 1.0), (1, 4.0), (2, 14.0), (3, 5.0), (4, 6.0)]


def test_an_update_that_cannot_be_read_is_reported(client: RoughMapClient, publishing: Publishing) -> None:
    tiles: Gathered[Tile] = Gathered()
    errors: Gathered[RoughMapError] = Gathered()
    with client.watch(tiles, on_error=errors):
        publishing.heard().put(info(0), payload=b"\xff no grid")
        publishing.session.delete("maps/site/updates/0/5/5")
        publishing.put(info(1))
        tiles.wait(lambda items: len(items) == 1, "the tile after the unreadable one")
    (error,) = errors.items
    assert isinstance(error, UnreadableAnswer)
    assert [tile.key for tile in tiles.items] == [(0, 1, 0)]


def test_what_a_callback_raises_does_not_end_the_watch(
    client: RoughMapClient, publishing: Publishing, caplog: pytest.LogCaptureFixture
) -> None:
    seen: Gathered[int] = Gathered()

    def callback(tile: Tile) -> None:
        seen(tile.key[1])
        if tile.key[1] == 0:
            raise KeyError("a planner's own mistake")

    with caplog.at_level(logging.ERROR), client.watch(callback):
        publishing.heard().put(info(0))
        publishing.put(info(1))
        seen.wait(lambda items: items == [0, 1], "the tile after it")
    assert "a planner's own mistake" in caplog.text


def test_after_the_end_no_callback_begins(client: RoughMapClient, publishing: Publishing) -> None:
    """The callback closes its own watch while another tile waits."""
    other: Gathered[int] = Gathered()
    closed = threading.Event()
    opened = threading.Event()
    seen: list[int] = []

    def callback(tile: Tile) -> None:
        wait_for(opened, "the watch to be known")
        seen.append(tile.key[1])
        watch.close()
        closed.set()

    watch = client.watch(callback)
    with client.watch(lambda tile: other(tile.key[1])):
        publishing.heard().put(info(0))
        publishing.put(info(1))
        other.wait(lambda items: 1 in items, "both tiles, by a second watch")
        opened.set()
        wait_for(closed, "the end")
        publishing.put(info(2))
        other.wait(lambda items: 2 in items, "the last tile, by a second watch")
    watch._thread.join(WAIT_S)
    assert not watch._thread.is_alive()
    assert seen == [0]


def test_the_client_ends_its_watches(pair: Pair, publishing: Publishing) -> None:
    client = RoughMapClient("site", session=pair[1])
    watch = client.watch(lambda _: None)
    client.close()
    assert not watch._thread.is_alive()
    watch.close()
    assert not pair[1].is_closed(), "the session is the caller's"
