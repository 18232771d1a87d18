"""A service that ends and comes back at the same place: the client's own session finds it again."""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
import zenoh
from net import WAIT_S, Gathered, locators, peer_config
from served import Served

from roughmap_client import NoAnswer, RoughMapClient, RoughMapError, Tile

BOX = (-1.0, -1.0, 1.0, 1.0)


@contextmanager
def service(endpoint: str, number: int) -> Iterator[tuple[Served, str]]:
    """A map served, with updates, on a session that listens at ``endpoint``; its instance and epoch are ``number``."""
    settings = {"updates": {"update_hz": 50.0}}
    with ExitStack() as stack:
        session = stack.enter_context(zenoh.open(peer_config(listen__endpoints=[endpoint])))
        served = Served(settings=settings, sessions=(session, session), instance=f"{number:032x}", epoch=number)
        stack.enter_context(served)
        stack.enter_context(served.updates(session=session))
        yield served, locators(session)[0]


def test_calls_and_watches_outlive_a_restart() -> None:
    """One call finds nobody, one waits for the service to come back, and a watch hears of the new one's tiles."""
    tiles: Gathered[Tile] = Gathered()
    with ExitStack() as stack:
        with service("tcp/127.0.0.1:0", 1) as (served, endpoint):
            client = stack.enter_context(RoughMapClient("site", endpoint, timeout=WAIT_S))
            stack.enter_context(client.watch(tiles))
            before = client.region(BOX)
            held = client.changes()
            served.add(np.array([[50.0, 0.0, 1.0]]))
            tiles.wait(lambda items: any(tile.key == (0, 7, 0) for tile in items), "a tile of the first")
        with pytest.raises(NoAnswer):
            client.region(BOX, timeout=0.3)

        waiting: Gathered[object] = Gathered()

        def ask() -> None:
            try:
                waiting(client.region(BOX))
            except RoughMapError as error:
                waiting(error)

        thread = threading.Thread(target=ask)
        thread.start()
        with service(endpoint, 2) as (served, again):
            assert again == endpoint
            (after,) = waiting.wait(bool, "the answer of the second")
            thread.join()
            assert not isinstance(after, RoughMapError), after
            np.testing.assert_array_equal(after["mean_height"], before["mean_height"])  # type: ignore[index]
            assert (before.epoch, after.epoch) == (1, 2)  # type: ignore[attr-defined]
            changes = client.changes(held.version)
            assert changes.complete
            assert changes.version.epoch == 2
            served.add(np.array([[60.0, 0.0, 1.0]]))
            tiles.wait(lambda items: any(tile.key == (0, 9, 0) for tile in items), "a tile of the second")
    assert {tile.epoch for tile in tiles.items if tile.key == (0, 9, 0)} == {2}
