"""Handing in messages: receipts, and what the client does when none comes."""

import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest
import zenoh
from foreign import Pair, foreign, refuse
from net import WAIT_S, open_pair

from roughmap_client import NoAnswer, QueryRefused, RoughMapClient
from roughmap_client import client as client_module
from roughmap_schemas import Receipt, model_bytes
from roughmap_schemas.encodings import json_encoding

KEY = "maps/site/ingest/*/*"


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    with open_pair() as pair:
        yield pair


@pytest.fixture
def client(pair: Pair) -> Iterator[RoughMapClient]:
    with RoughMapClient("site", session=pair[1], timeout=WAIT_S) as client:
        yield client


def give(query: zenoh.Query, number: int = 4, duplicate: bool = False) -> None:
    receipt = Receipt(input=number, epoch=2, duplicate=duplicate)
    query.reply(str(query.key_expr), model_bytes(receipt), encoding=json_encoding("Receipt"))


class Heard:
    """What a service hears; the queries are treated by ``steps`` in turn, the last of them by ``give``."""

    def __init__(self, *steps: Callable[[zenoh.Query], object]) -> None:
        self.steps = list(steps)
        self.messages: list[tuple[str, str, bytes]] = []

    def __call__(self, query: zenoh.Query) -> None:
        assert query.payload is not None
        self.messages.append((str(query.key_expr), str(query.encoding), query.payload.to_bytes()))
        (self.steps.pop(0) if self.steps else give)(query)


@pytest.mark.parametrize(
    ("kind", "schema"), [("points", "PointCloud"), ("odometry", "Odometry"), ("transform", "FrameTransform")]
)
def test_a_receipt(pair: Pair, client: RoughMapClient, kind: client_module.InputKind, schema: str) -> None:
    heard, message = Heard(), bytes(range(256))
    with foreign(pair, KEY, heard):
        receipt = client.ingest(message, "mule-2", kind=kind)
    assert (receipt.input, receipt.epoch, receipt.durable, receipt.duplicate) == (4, 2, True, False)
    assert heard.messages == [
        (f"maps/site/ingest/mule-2/{kind}", f"application/protobuf;foxglove.{schema}", message),
    ]


def test_the_same_bytes_are_sent_again_when_the_first_are_ignored(pair: Pair, client: RoughMapClient) -> None:
    heard = Heard(lambda _: None, lambda query: give(query, 9, duplicate=True))
    with foreign(pair, KEY, heard):
        receipt = client.ingest(b"the cloud", "mule")
    assert (receipt.input, receipt.duplicate) == (9, True)
    first, second = heard.messages
    assert first == second


def test_they_are_sent_again_when_the_receipt_does_not_come(
    pair: Pair, client: RoughMapClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A service that hangs with the first: the second is not held up until the end of the time limit."""
    monkeypatch.setattr(client_module, "RECEIPT_S", 0.3)
    held: list[zenoh.Query] = []
    messages: list[bytes] = []

    def handle(query: zenoh.Query) -> None:
        assert query.payload is not None
        messages.append(query.payload.to_bytes())
        if len(messages) == 1:
            held.append(query)  # neither answered nor ended
            return
        give(query)
        query.drop()

    with foreign(pair, KEY, handle, end=False):
        assert client.ingest(b"the cloud", "mule").input == 4
        held.pop().drop()
    assert messages == [b"the cloud"] * 2


@pytest.mark.parametrize("code", ["busy", "log_unavailable", "shutting_down"])
def test_a_refusal_that_passes_is_waited_out(pair: Pair, client: RoughMapClient, code: str) -> None:
    heard = Heard(lambda query: refuse(query, code))
    with foreign(pair, KEY, heard):
        assert client.ingest(b"the cloud", "mule").input == 4
    assert len(heard.messages) == 2


def test_each_pause_is_twice_the_one_before_up_to_a_limit(
    pair: Pair, client: RoughMapClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(client_module, "time", SimpleNamespace(monotonic=time.monotonic, sleep=pauses.append))
    with foreign(pair, KEY, Heard(*[lambda query: refuse(query, "busy")] * 7)):
        client.ingest(b"the cloud", "mule")
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]


@pytest.mark.parametrize("code", ["bad_message", "bad_encoding", "too_large", "unknown_sensor", "unknown_robot"])
def test_another_refusal_is_raised_at_once(pair: Pair, client: RoughMapClient, code: str) -> None:
    heard = Heard(lambda query: refuse(query, code))
    with foreign(pair, KEY, heard), pytest.raises(QueryRefused) as caught:
        client.ingest(b"the cloud", "mule")
    assert caught.value.code == code
    assert len(heard.messages) == 1


def test_without_a_receipt_the_end_is_no_answer(pair: Pair) -> None:
    heard = Heard(*[lambda _: None] * 1000)
    with (
        foreign(pair, KEY, heard),
        RoughMapClient("site", session=pair[1], timeout=0.7) as client,
        pytest.raises(NoAnswer),
    ):
        client.ingest(b"the cloud", "mule")
    assert len(heard.messages) > 1
