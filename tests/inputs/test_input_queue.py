"""What is let in from real sessions when nobody takes it up: what is dropped, what is refused, what never is."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from typing import cast

import pytest
import zenoh
from net import WAIT_S, open_pair, wait_for

from roughmap_client import QueryRefused
from roughmap_client.session import ask
from roughmap_schemas import Config, Keys
from roughmap_schemas.kinds import Kind
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.queue import COMPANY, InputMessage, InputQueue
from roughmap_service.inputs.receipts import IngestReply, ReceiptSender
from roughmap_service.inputs.streams import Streams
from roughmap_service.inputs.subscriptions import ZenohInputs

LIMIT = 1000
"""Bytes of clouds that may be queued here."""


@dataclass
class Door:
    """An intake that nobody takes from, and a client's session."""

    client: zenoh.Session
    intake: InputQueue
    counters: Counters

    def put(self, kind: str, robot: str, size: int, mark: int = 0) -> None:
        """Publish ``size`` bytes that begin with ``mark``: what they say is looked at later, not here."""
        payload = bytes([mark]) + bytes(size - 1)
        self.client.put(f"robots/{robot}/{kind}", payload, congestion_control=zenoh.CongestionControl.BLOCK)

    def refused(self, key: str, size: int) -> str:
        """The code with which a request is refused; all that was published before is taken in by then."""
        with pytest.raises(QueryRefused) as refusal:
            ask(self.client, key, timeout=30.0, payload=bytes(size)).single()
        return refusal.value.code

    def settle(self) -> None:
        assert self.refused("maps/site/ingest/no!name/odometry", 1) == "bad_key"

    def taken(self) -> list[tuple[str, str, int]]:
        """(kind, robot, mark) of what is queued."""
        messages, _, _ = self.intake.take(0.0)
        return [(message.kind.value, message.robot, message.payload[0]) for message in messages]


@pytest.fixture
def door() -> Iterator[Door]:
    with ExitStack() as stack:
        server, client = stack.enter_context(open_pair())
        counters, keys = Counters(), Keys("site")
        intake = InputQueue(LIMIT, counters)
        replies = stack.enter_context(ReceiptSender())
        stack.enter_context(ZenohInputs(server, keys, intake, replies, 2 * LIMIT, counters, Streams(Config())))
        # The queryables are declared last: where one is known, so is all the rest.
        known = threading.Event()
        querier = client.declare_querier("maps/site/ingest/a/transform")
        querier.declare_matching_listener(lambda status: known.set() if status.matching else None)
        if not querier.matching_status.matching:
            wait_for(known, "the declarations")
        yield Door(client, intake, counters)


def test_the_oldest_cloud_of_the_robot_that_holds_most_goes(door: Door) -> None:
    for robot, size, mark in (("a", 300, 1), ("b", 400, 2), ("a", 300, 3), ("b", 200, 4)):
        door.put("points", robot, size, mark)
    door.settle()
    assert door.taken() == [("points", "b", 2), ("points", "a", 3), ("points", "b", 4)]
    assert door.counters.snapshot().refused["busy"] == 1


def test_a_pose_never_goes_for_a_clouds_sake(door: Door) -> None:
    door.put("odometry", "a", 900, 1)
    for mark in range(2, 9):
        door.put("points", "a", 900, mark)
    door.put("transform", "a", 900, 9)
    door.settle()
    assert door.taken() == [("odometry", "a", 1), ("points", "a", 8), ("transform", "a", 9)]
    assert door.counters.snapshot().refused["busy"] == 6


def test_who_floods_poses_drops_its_own(door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roughmap_service.inputs.queue.MAX_POSES", 4)
    for robot, mark in (("loud", 1), ("quiet", 2), ("loud", 3), ("loud", 4), ("loud", 5), ("quiet", 6), ("loud", 7)):
        door.put("odometry", robot, 10, mark)
    assert door.refused("maps/site/ingest/loud/odometry", 10) == "busy"
    assert door.taken() == [("odometry", "loud", 1), ("odometry", "quiet", 2), ("odometry", "loud", 3),
                            ("odometry", "quiet", 6)]  # fmt: skip
    assert door.counters.snapshot().refused["busy"] == 4


def test_of_a_flood_each_robot_gets_its_share_taken(door: Door, monkeypatch: pytest.MonkeyPatch) -> None:
    """And the time up to which all was heard is that of what is left."""
    monkeypatch.setattr("roughmap_service.inputs.queue.TURN_MESSAGES", 4)
    for mark in range(1, 7):
        door.put("odometry", "loud", 10, mark)
    for mark in (7, 8):
        door.put("points", "quiet", 10, mark)
    door.settle()
    messages, _, heard = door.intake.take(0.0)
    assert [message.payload[0] for message in messages] == [1, 2, 7, 8]
    assert heard < messages[-1].arrival
    messages, _, heard = door.intake.take(0.0)
    assert [message.payload[0] for message in messages] == [3, 4, 5, 6]
    assert heard > messages[-1].arrival
    assert door.intake.take(0.0)[0] == []


def test_a_request_is_refused_as_busy_and_drops_nothing(door: Door) -> None:
    door.put("points", "a", 900, 1)
    assert door.refused("maps/site/ingest/b/points", 900) == "busy"
    assert door.taken() == [("points", "a", 1)]
    assert door.counters.snapshot().refused["busy"] == 1


def test_taking_makes_room(door: Door) -> None:
    for mark in (1, 2):
        door.put("points", "a", 900, mark)
        door.settle()
        assert door.taken() == [("points", "a", mark)]
    assert door.counters.snapshot().refused["busy"] == 0


def test_after_the_end_everything_is_refused(door: Door) -> None:
    door.put("points", "a", 10, 1)
    door.settle()
    door.intake.close()
    for kind in ("points", "odometry", "transform"):
        assert door.refused(f"maps/site/ingest/a/{kind}", 10) == "shutting_down"
        door.put(kind, "a", 10)
    door.settle()
    assert door.counters.snapshot().refused["shutting_down"] == 6
    assert door.taken() == [("points", "a", 1)], "what was let in before is still there"


def test_too_large_a_message_is_not_even_copied(door: Door) -> None:
    assert door.refused("maps/site/ingest/a/odometry", 2 * LIMIT + 1) == "too_large"
    door.put("odometry", "a", 2 * LIMIT + 1)
    door.settle()
    assert door.counters.snapshot().refused["too_large"] == 2
    assert door.taken() == []


def test_missing_message_numbers_are_counted_by_key(door: Door) -> None:
    """Clouds and poses are numbered apart; a number that goes back means that the publisher restarted."""
    numbers = {
        ("points", "a"): [*range(7, 16), 18],
        ("odometry", "a"): [*range(9)],
        ("points", "b"): [*range(9), *range(9), 10],
    }
    for (kind, robot), sent in numbers.items():
        for number in sent:
            door.client.put(f"robots/{robot}/{kind}", b"x", attachment=number.to_bytes(8, "little"))
    door.client.put("robots/a/points", b"x", attachment=b"short")
    door.client.put("robots/a/points", b"x")
    door.settle()
    assert dict(door.counters.snapshot().gaps) == {"a": 2, "b": 1}


def test_zenoh_numbers_the_messages_of_a_publisher_itself(door: Door) -> None:
    """With miss detection: two drivers on one key, one restarts; their own attachments are not looked at."""
    detect = zenoh.ext.MissDetectionConfig()
    for _ in range(2):
        drivers = [
            zenoh.ext.declare_advanced_publisher(door.client, "robots/a/points", sample_miss_detection=detect)
            for _ in range(2)
        ]
        for number in range(3):
            for driver in drivers:
                driver.put(b"x", attachment=(number * 100).to_bytes(8, "little"))
        for driver in drivers:
            driver.undeclare()
    door.settle()
    assert dict(door.counters.snapshot().gaps) == {}
    plain = door.client.declare_publisher("robots/b/points")
    for number in (0, 1, 5):
        plain.put(b"x", source_info=zenoh.SourceInfo(plain.id, number))
    door.settle()
    assert dict(door.counters.snapshot().gaps) == {"b": 3}


@pytest.mark.parametrize(
    "encoding", ["application/protobuf", "application/protobuf;foxglove.PointCloud", "zenoh/bytes"]
)
def test_encodings_that_the_key_makes_clear(door: Door, encoding: str) -> None:
    door.client.put("robots/a/points", b"\x01", encoding=zenoh.Encoding(encoding))
    door.settle()
    assert door.taken() == [("points", "a", 1)]
    assert not door.counters.snapshot().refused["bad_encoding"]


def message(kind: Kind, mark: int, reply: IngestReply | None = None) -> InputMessage:
    return InputMessage(kind, "rover", bytes([mark]), 0, time.monotonic(), reply)


@pytest.mark.parametrize("last", ["cloud", "ingested", "company", "command", "end"])
def test_poses_wait_together_until_something_does_not(last: str) -> None:
    intake = InputQueue(LIMIT, Counters())
    poses = [message(Kind.ODOMETRY, mark) for mark in range(COMPANY - 1)]
    more: list[InputMessage] = []
    with ThreadPoolExecutor(1) as pool, ReceiptSender() as receipts:
        taken = pool.submit(intake.take, WAIT_S, WAIT_S)
        for one in poses:
            intake.put(one)
        if last == "command":
            intake.command(lambda: None)
        elif last == "end":
            intake.close()
        else:
            reply = IngestReply(cast("zenoh.Query", None), receipts) if last == "ingested" else None
            more = [message(Kind.POINTS if last == "cloud" else Kind.ODOMETRY, COMPANY, reply)]
            intake.put(more[0])
        messages, commands, _ = taken.result(WAIT_S)
    assert messages == poses + more
    assert len(commands) == (last == "command")


def test_poses_that_nothing_follows_are_taken_in_time() -> None:
    intake = InputQueue(LIMIT, Counters())
    intake.put(message(Kind.ODOMETRY, 1))
    assert len(intake.take(WAIT_S, 0.001)[0]) == 1
    assert intake.take(0.001, WAIT_S)[0] == []


def test_what_a_turn_left_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("roughmap_service.inputs.queue.TURN_MESSAGES", 4)
    intake = InputQueue(LIMIT, Counters())
    for mark in range(6):
        intake.put(message(Kind.ODOMETRY, mark))
    taken = [intake.take(WAIT_S, WAIT_S if turn else 0.001)[0] for turn in range(2)]
    assert [len(messages) for messages in taken] == [4, 2]
