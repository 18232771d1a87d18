"""Answers that must not be used, and none at all: each its error of one tree, in bounded time."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import zenoh
import zstandard
from foreign import ONE, OTHER, Pair, foreign, grid, info, refuse, send_tile
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from net import WAIT_S, open_pair
from served import Served

from roughmap_client import (
    BadArgument,
    IncompleteAnswer,
    MixedInstances,
    NoAnswer,
    QueryRefused,
    RoughMapClient,
    RoughMapError,
    UnreadableAnswer,
)
from roughmap_schemas import CellAnswer, model_bytes
from roughmap_schemas.encodings import GRID, json_encoding

Ask = Callable[..., Any]

CALLS: dict[str, Ask] = {
    "region": lambda c, **more: c.region((0, 0, 1, 1), **more),
    "tiles": lambda c, **more: c.tiles(**more),
    "changes": lambda c, **more: c.changes(**more),
    "cells": lambda c, **more: c.cells([(0, 0)], **more),
    "status": lambda c, **more: c.status(**more),
    "ingest": lambda c, **more: c.ingest(b"a cloud", "mule", **more),
}
ASKED = {"region", "tiles", "cells", "status"}
KEYS = {"region": "maps/site/region", "tiles": "maps/site/tiles/*/*/*", "cells": "maps/site/cells",
        "status": "maps/site/status", "ingest": "maps/site/ingest/*/points"}  # fmt: skip


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with open_pair() as pair:
        yield pair


@pytest.fixture(scope="module")
def client(pair: Pair) -> Iterator[RoughMapClient]:
    """Long enough a limit that no test here may come to it."""
    with RoughMapClient("site", session=pair[1], timeout=WAIT_S) as client:
        yield client


@pytest.mark.parametrize("call", CALLS)
def test_nobody_is_there(pair: Pair, call: str) -> None:
    with RoughMapClient("site", session=pair[1], timeout=0.3) as client, pytest.raises(NoAnswer):
        CALLS[call](client)


@pytest.mark.parametrize("call", CALLS)
def test_a_calls_own_limit_holds_in_place_of_the_clients(pair: Pair, call: str) -> None:
    with RoughMapClient("site", session=pair[1], timeout=1e6) as client, pytest.raises(NoAnswer):
        CALLS[call](client, timeout=0.3)


@pytest.mark.parametrize("call", CALLS)
def test_a_service_that_hangs(pair: Pair, call: str) -> None:
    """It takes the question and never answers: the time limit ends the call."""
    leave = threading.Event()
    with ExitStack() as stack:
        for key in KEYS.values():
            stack.enter_context(foreign(pair, key, lambda _: leave.wait(WAIT_S)))
        stack.callback(leave.set)
        with RoughMapClient("site", session=pair[1], timeout=0.3) as client, pytest.raises(NoAnswer):
            CALLS[call](client)


def test_no_connection() -> None:
    with socket.socket() as taken:  # bound, and nobody listens there
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(NoAnswer, match="no connection to tcp/127"):
            RoughMapClient("site", f"tcp/127.0.0.1:{taken.getsockname()[1]}", timeout=0.3)


def test_a_closed_session() -> None:
    with open_pair() as (_, session):
        client = RoughMapClient("site", session=session, timeout=WAIT_S)
    for call in CALLS.values():
        with pytest.raises(NoAnswer):
            call(client)
    with pytest.raises(NoAnswer):
        client.watch(lambda _: None)
    client.close()


TILES: dict[str, tuple[type[RoughMapError], Callable[[zenoh.Query], None]]] = {
    "two of three": (
        IncompleteAnswer,
        lambda q: [send_tile(q, info(x, answer_tiles=3)) for x in (0, 1)] and None,
    ),
    "one more than there are": (
        IncompleteAnswer,
        lambda q: [send_tile(q, info(x, answer_tiles=1)) for x in (0, 1)] and None,
    ),
    "one of them twice": (IncompleteAnswer, lambda q: [send_tile(q, info(0, answer_tiles=2)) for _ in "ab"] and None),
    "one more, the same": (IncompleteAnswer, lambda q: [send_tile(q, info(0, answer_tiles=1)) for _ in "ab"] and None),
    "two states of the map": (
        IncompleteAnswer,
        lambda q: [send_tile(q, info(x, answer_tiles=2, map_sequence=9 + x)) for x in (0, 1)] and None,
    ),
    "two epochs": (
        IncompleteAnswer,
        lambda q: [send_tile(q, info(x, answer_tiles=2, epoch=3 + x)) for x in (0, 1)] and None,
    ),
    "two instances": (
        MixedInstances,
        lambda q: [send_tile(q, info(x, answer_tiles=2, instance=(ONE, OTHER)[x])) for x in (0, 1)] and None,
    ),
    "no grid": (UnreadableAnswer, lambda q: send_tile(q, info(), b"\xff\xfe no protobuf")),
    "half a tile": (UnreadableAnswer, lambda q: send_tile(q, info(), grid(side=32))),
    "another layer": (UnreadableAnswer, lambda q: send_tile(q, info(), grid(("range",)))),
    "a layer too many": (UnreadableAnswer, lambda q: send_tile(q, info(), grid(("mean_height", "range")))),
    "no numbers": (
        UnreadableAnswer,
        lambda q: q.reply("maps/site/tiles/0/0/0", grid(), encoding=GRID,
                          attachment=model_bytes(info().model_copy(update={"x": None}))),
    ),
    "no attachment": (UnreadableAnswer, lambda q: q.reply("maps/site/tiles/0/0/0", grid(), encoding=GRID)),
    "another attachment": (
        UnreadableAnswer, lambda q: q.reply("maps/site/tiles/0/0/0", grid(), encoding=GRID, attachment=b'{"map": 1}')
    ),
    "another encoding": (
        UnreadableAnswer,
        lambda q: q.reply("maps/site/tiles/0/0/0", grid(), encoding="text/plain", attachment=model_bytes(info())),
    ),
    "compressed, and not": (UnreadableAnswer, lambda q: send_tile(q, info(compression="zstd"))),
    "an error of another kind": (UnreadableAnswer, lambda q: q.reply_err(b"no such file", encoding="text/plain")),
    "an error after a tile": (QueryRefused, lambda q: (send_tile(q, info(answer_tiles=2)), refuse(q, "internal"))[1]),
}  # fmt: skip


@pytest.mark.parametrize("fault", TILES)
def test_tiles_that_must_not_be_used(pair: Pair, client: RoughMapClient, fault: str) -> None:
    error, answer = TILES[fault]
    with foreign(pair, KEYS["tiles"], answer), pytest.raises(error) as caught:
        client.tiles()
    assert isinstance(caught.value, RoughMapError)
    assert type(caught.value) is error


def test_a_tile_that_unpacks_to_gigabytes(pair: Pair, client: RoughMapClient) -> None:
    """A few packed bytes of zeros, laid out as rows of a tile with much between them."""
    message = GridMessage.FromString(grid())
    message.row_stride = 1 << 20
    message.data = zstandard.compress(bytes(64 << 20))
    payload = message.SerializeToString()
    assert len(payload) < 1 << 16
    bomb = foreign(pair, KEYS["tiles"], lambda q: send_tile(q, info(compression="zstd"), payload))
    with bomb, pytest.raises(UnreadableAnswer, match="too_large"):
        client.tiles()


@pytest.mark.parametrize("call", ["region", "cells", "status", "ingest"])
def test_more_answers_than_one_are_not_gathered(pair: Pair, client: RoughMapClient, call: str) -> None:
    """Whoever goes on answering, with whatever, is not waited for, nor kept in memory."""
    leave = threading.Event()

    def answer(query: zenoh.Query) -> None:
        for _ in range(2):
            query.reply(str(query.key_expr), bytes(1000))
        leave.wait(2 * WAIT_S)

    with foreign(pair, KEYS[call], answer):
        with pytest.raises(MixedInstances):
            CALLS[call](client)
        leave.set()


def test_an_answer_that_breaks_off(pair: Pair) -> None:
    """A tile of two comes, and the rest not within the time limit."""
    leave = threading.Event()

    def answer(query: zenoh.Query) -> None:
        send_tile(query, info(answer_tiles=2))
        leave.wait(WAIT_S)

    with foreign(pair, KEYS["tiles"], answer):
        with RoughMapClient("site", session=pair[1], timeout=0.5) as client, pytest.raises(IncompleteAnswer):
            client.tiles()
        leave.set()


@pytest.mark.parametrize("call", sorted(ASKED))
def test_two_services_on_the_same_keys(call: str) -> None:
    with (
        Served() as served,
        Served(sessions=(served.server, served.asker), instance=OTHER),
        RoughMapClient("site", session=served.asker, timeout=WAIT_S) as client,
        pytest.raises(MixedInstances),
    ):
        CALLS[call](client)


@pytest.mark.parametrize("call", ["region", "cells", "status", "ingest"])
def test_json_or_a_grid_of_another_form(pair: Pair, client: RoughMapClient, call: str) -> None:
    def answer(query: zenoh.Query) -> None:
        query.reply(str(query.key_expr), b'{"map": "site"}')

    with foreign(pair, KEYS[call], answer), pytest.raises(UnreadableAnswer):
        CALLS[call](client)


def test_fewer_cells_than_places(pair: Pair, client: RoughMapClient) -> None:
    def answer(query: zenoh.Query) -> None:
        message = CellAnswer(map="site", instance=ONE, epoch=1, sequence=1, cells=[])
        query.reply(str(query.key_expr), model_bytes(message), encoding=json_encoding("CellAnswer"))

    with foreign(pair, KEYS["cells"], answer), pytest.raises(UnreadableAnswer):
        client.cells([(0, 0)])


def test_a_service_that_is_busy_is_asked_again(pair: Pair, client: RoughMapClient) -> None:
    codes = ["busy", "shutting_down", "busy"]

    def answer(query: zenoh.Query) -> None:
        if codes:
            refuse(query, codes.pop())
        else:
            send_tile(query, info())

    with foreign(pair, KEYS["tiles"], answer):
        (tile,) = client.tiles()
    assert codes == []
    assert (tile["mean_height"] == 1.5).all()


def test_a_service_that_stays_busy_is_reported_at_the_end(pair: Pair) -> None:
    with (
        foreign(pair, KEYS["region"], lambda q: refuse(q, "busy")),
        RoughMapClient("site", session=pair[1], timeout=1.5) as client,
        pytest.raises(QueryRefused, match="busy: as the test wants it") as caught,
    ):
        client.region((0, 0, 1, 1))
    assert caught.value.code == "busy"


@pytest.mark.parametrize(
    "ask",
    [
        lambda c: c.cells(np.zeros((2, 3))),
        lambda c: c.cells([0.0, 1.0, 2.0]),
        lambda c: c.cells("here"),
        lambda c: c.ingest(b"", "a/b"),
        lambda c: c.ingest(b"", ""),
        lambda c: c.ingest(b"", "*"),
        lambda c: c.ingest(b"", "mule", kind="clouds"),
        lambda _: RoughMapClient("a map"),
        lambda _: RoughMapClient("site", keys={"tile": "t/{z}/{x}/{y}"}),
    ],
)
def test_what_no_service_could_be_asked(client: RoughMapClient, ask: Ask) -> None:
    with pytest.raises(BadArgument) as caught:
        ask(client)
    assert isinstance(caught.value, RoughMapError)
    assert isinstance(caught.value, ValueError)
