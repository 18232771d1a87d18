"""What the service says unasked: the status once a second, and updates to those who come right after a reset."""

import itertools
import json
import logging
from typing import Any

import numpy as np
import pytest
import zenoh
from asking_raw import RawTile
from net import Gathered
from served import INSTANCE, Served

from roughmap_schemas import MapStatus
from roughmap_service.watch.status import StatusPublisher


def test_the_status_is_published_once_a_second() -> None:
    """Seen from the statuses' own clock: no two are nearer than the contract's second."""
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served() as served:
        subscriber = served.asker.declare_subscriber("maps/site/status", heard)
        assert served.status is not None
        with StatusPublisher(served.server, served.keys, served.status):
            heard.wait(bool, "a first status")
            served.add(np.array([[0.0, 0.0, 1.0]]))
            heard.wait(lambda items: len(items) >= 3, "two more")
        subscriber.undeclare()
    assert {str(sample.encoding) for sample in heard.items} == {"application/json;roughmap.MapStatus"}
    statuses = [json.loads(sample.payload.to_bytes()) for sample in heard.items]
    for earlier, later in itertools.pairwise(statuses):
        # A wait of a second lies between; a tenth of one is left to the grain of the system's clocks.
        assert later["uptime_s"] - earlier["uptime_s"] > 0.9
    assert statuses[0]["instance"] == INSTANCE
    assert (statuses[0]["sequence"], statuses[-1]["sequence"]) == (5, 6)


def test_one_status_that_fails_is_followed_by_others(caplog: pytest.LogCaptureFixture) -> None:
    heard: Gathered[zenoh.Sample] = Gathered()
    faults = [ValueError("no status today")]
    with Served() as served:
        make: Any = served.status

        def status() -> MapStatus:
            if faults:
                raise faults.pop()
            made = make()
            assert isinstance(made, MapStatus)
            return made

        subscriber = served.asker.declare_subscriber("maps/site/status", heard)
        with caplog.at_level(logging.ERROR), StatusPublisher(served.server, served.keys, status):
            heard.wait(bool, "the status after the one that failed")
        subscriber.undeclare()
    assert "no status today" in caplog.text


def test_a_subscriber_right_after_a_reset_gets_the_emptied_tiles() -> None:
    """They may hold tiles that they asked for before it."""
    heard: Gathered[zenoh.Sample] = Gathered()
    with Served({"updates": {"update_hz": 50.0, "levels": [1]}}) as served:
        with served.map.freeze(1) as frozen:
            known = {(1, x, y) for x, y in frozen.tiles.tolist()}
        with served.updates():
            served.reset()
            served.add(np.array([[0.5, 0.5, 1.0]]))
            subscriber = served.asker.declare_subscriber("maps/site/updates/1/*/*", heard)
            heard.wait(lambda items: len({str(item.key_expr) for item in items}) == len(known), "every tile")
        subscriber.undeclare()
    tiles = {tile.key: tile for tile in map(RawTile, heard.items)}
    assert set(tiles) == known
    assert {key for key, tile in tiles.items() if tile.info["known_cells"]} == {(1, 0, 0)}
    assert {tile.info["epoch"] for tile in tiles.values()} == {6}


def test_a_round_that_fails_is_made_up_for(caplog: pytest.LogCaptureFixture) -> None:
    heard: Gathered[zenoh.Sample] = Gathered()
    faults = [OSError("no room in the log")]

    def record(*_: object) -> None:
        if faults:
            raise faults.pop()

    with Served({"updates": {"update_hz": 50.0}}) as served, caplog.at_level(logging.ERROR):
        subscriber = served.asker.declare_subscriber("maps/site/updates/0/*/*", heard)
        with served.updates(record):
            served.add(np.array([[1.0, 1.0, 1.0], [50.0, 1.0, 1.0]]))
            heard.wait(
                lambda items: (
                    {"maps/site/updates/0/0/0", "maps/site/updates/0/7/0"} <= {str(i.key_expr) for i in items}
                ),
                "both tiles",
            )
        subscriber.undeclare()
    assert faults == []
    assert "no room in the log" in caplog.text
