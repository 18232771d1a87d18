"""A service that speaks another contract is refused by name, at the first reply and without a query of its own."""

import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
from foreign import Pair, foreign, grid, info
from net import WAIT_S, Gathered, open_pair
from served import Served

import roughmap_schemas.contract
from roughmap_client import ContractMismatch, RoughMapClient, RoughMapError
from roughmap_schemas import CONTRACT_VERSION, QueryError, Receipt, model_bytes
from roughmap_schemas.encodings import GRID
from roughmap_schemas.messages import CellAnswer, Reply

CALLS: dict[str, tuple[str, Callable[[RoughMapClient], Any]]] = {
    "region": ("maps/site/region", lambda c: c.region((0, 0, 1, 1))),
    "tiles": ("maps/site/tiles/*/*/*", lambda c: c.tiles()),
    "cells": ("maps/site/cells", lambda c: c.cells(np.empty((0, 2)))),
    "status": ("maps/site/status", lambda c: c.status()),
    "ingest": ("maps/site/ingest/*/points", lambda c: c.ingest(b"a cloud", "mule")),
}
REPLIES: dict[str, Reply] = {
    "region": info(),
    "tiles": info(),
    "cells": CellAnswer(map="site", instance="1" * 32, epoch=1, sequence=1, cells=[]),
    "ingest": Receipt(input=1, epoch=1),
}
ASKED = ("region", "tiles", "cells", "status", "changes")


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with open_pair() as pair:
        yield pair


@pytest.fixture(scope="module")
def client(pair: Pair) -> Iterator[RoughMapClient]:
    with RoughMapClient("site", session=pair[1], timeout=WAIT_S) as client:
        yield client


def in_contract(reply: Reply, version: str | None, **more: object) -> bytes:
    """The reply as a service of another release writes it; None: of one from before the contract had a version."""
    values = {**json.loads(model_bytes(reply)), **more, "contract": version}
    return json.dumps(
        {name: value for name, value in values.items() if value is not None or name != "contract"}
    ).encode()


def answering(name: str, text: bytes) -> Callable[[zenoh.Query], None]:
    """Answers with that JSON, beside a grid where the call is answered by one."""

    def answer(query: zenoh.Query) -> None:
        key = "maps/site/tiles/0/0/0" if name == "tiles" else str(query.key_expr)
        if name in {"region", "tiles"}:
            query.reply(key, grid(), encoding=GRID, attachment=text)
        else:
            query.reply(key, text)

    return answer


@pytest.mark.parametrize("name", REPLIES)
@pytest.mark.parametrize(
    ("version", "said"),
    [
        ("2.0", "the service speaks contract 2.0, this client speaks 1.x"),
        ("0.9", "the service speaks contract 0.9, this client speaks 1.x"),
        (None, f"older than {CONTRACT_VERSION}; upgrade the service"),
    ],
)
def test_another_major_is_refused(
    pair: Pair, client: RoughMapClient, name: str, version: str | None, said: str
) -> None:
    key, call = CALLS[name]
    asked: list[str] = []
    text = in_contract(REPLIES[name], version)

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        answering(name, text)(query)

    with foreign(pair, key, answer), pytest.raises(ContractMismatch) as caught:
        call(client)
    assert said in str(caught.value)
    assert isinstance(caught.value, RoughMapError)
    assert len(asked) == 1, "no query but the call's own"


@pytest.mark.parametrize("name", CALLS)
def test_a_reply_that_only_names_another_major_is_refused_for_that(
    pair: Pair, client: RoughMapClient, name: str
) -> None:
    """Of a later major nothing else may be where it was."""
    key, call = CALLS[name]
    text = json.dumps({"contract": "3.1", "who": "another form"}).encode()
    with foreign(pair, key, answering(name, text)), pytest.raises(ContractMismatch, match=r"contract 3\.1"):
        call(client)


@pytest.mark.parametrize("name", REPLIES)
def test_a_later_minor_is_read(pair: Pair, client: RoughMapClient, name: str) -> None:
    key, call = CALLS[name]
    with foreign(pair, key, answering(name, in_contract(REPLIES[name], "1.99", later=[1, 2]))):
        call(client)


def test_an_error_of_another_major(pair: Pair, client: RoughMapClient) -> None:
    error = in_contract(QueryError(code="bad_bbox", message="in another form"), "2.0")
    with (
        foreign(pair, "maps/site/region", lambda query: query.reply_err(error)),
        pytest.raises(ContractMismatch, match=r"contract 2\.0"),
    ):
        client.region((0, 0, 1, 1))


def test_an_update_of_another_major(pair: Pair, client: RoughMapClient) -> None:
    wrong: Gathered[RoughMapError] = Gathered()
    tiles: Gathered[object] = Gathered()
    key = "maps/site/updates/0/0/0"
    publisher = pair[0].declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    there: Gathered[zenoh.MatchingStatus] = Gathered()
    publisher.declare_matching_listener(there)
    with client.watch(tiles, on_error=wrong):
        there.wait(lambda seen: any(status.matching for status in seen), "the watch's subscription")
        publisher.put(grid(), encoding=GRID, attachment=in_contract(info(), "2.0"))
        (error,) = wrong.wait(bool, "the error")
        assert isinstance(error, ContractMismatch)
        publisher.put(grid(), encoding=GRID, attachment=model_bytes(info()))
        tiles.wait(bool, "the tile after it")
    publisher.undeclare()


def test_a_service_says_its_contract_and_a_client_of_another_major_refuses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {**{name: call for name, (_, call) in CALLS.items()}, "changes": lambda c: c.changes()}
    with Served() as served, RoughMapClient("site", session=served.asker, timeout=WAIT_S) as client:
        assert client.status().contract == CONTRACT_VERSION
        assert client.region((0, 0, 1, 1)).info.contract == CONTRACT_VERSION
        for name in ASKED:
            calls[name](client)
        monkeypatch.setattr(roughmap_schemas.contract, "CONTRACT_VERSION", "2.0")
        monkeypatch.setattr("roughmap_client.contract.CONTRACT_VERSION", "2.0")
        for name in ASKED:
            with pytest.raises(ContractMismatch, match=rf"contract {CONTRACT_VERSION}, this client speaks 2\.x"):
                calls[name](client)
