"""Ingest: what a receipt promises, what it says of a message sent twice, and what happens to it at the end."""

import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net import Gathered
from processes import GROUND, LEVEL, T0, Feed, Service, connected, inputs_in, replay, running

from roughmap_schemas import MapStatus, Receipt, encode_cloud, encode_odometry, encode_transform

S = 10**9

Running = tuple[Service, Feed]


def placed(number: int) -> bytes:
    """A small cloud in the map's frame, no two alike."""
    return encode_cloud(GROUND + np.array([number, 0.0, 0.0]), T0 + number, "map")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The log is flushed so seldom by itself that only receipts bring anything to the file within a test."""
    with running(tmp_path_factory.mktemp("receipts"), log={"flush_interval": 60.0}) as both:
        yield both


@pytest.mark.parametrize("kind", ["points", "odometry", "transform"])
def test_at_the_receipt_the_message_is_in_the_file(both: Running, kind: str) -> None:
    service, feed = both
    payload = {
        "points": placed(1),
        "odometry": encode_odometry(T0, "map", (1, 2, 3), LEVEL),
        "transform": encode_transform(T0, "map", "odom", (1, 2, 3), LEVEL),
    }[kind]
    receipt = feed.ingest(kind, "r1", payload)
    (file,) = service.log.glob("*.mcap")
    content = file.read_bytes()
    assert payload in content
    assert receipt.durable
    assert not receipt.duplicate
    assert receipt.epoch == feed.client.status().epoch == 1
    logged = inputs_in(service.log)[receipt.input - 1]
    assert (logged.topic, logged.data) == (f"robots/r1/{kind}", payload), "as if it had been published"


def test_many_in_flight_have_their_receipts_in_the_order_of_the_log(both: Running) -> None:
    service, feed = both
    told: Gathered[tuple[bytes, Receipt | str]] = Gathered()
    payloads = [placed(100 + n) for n in range(200)]
    for payload in payloads:
        feed.send("points", "many", payload, lambda answer, payload=payload: told((payload, answer)))  # type: ignore[misc]
    answers = told.wait(lambda items: len(items) == len(payloads), "all receipts")
    numbers = {payload: answer.input for payload, answer in answers if isinstance(answer, Receipt)}
    assert len(numbers) == len(payloads)
    logged = inputs_in(service.log)
    assert all(logged[number - 1].data == payload for payload, number in numbers.items())
    assert sorted(numbers.values()) == [numbers[payload] for payload in payloads]


def test_what_is_sent_twice_is_logged_once(both: Running) -> None:
    service, feed = both
    first = feed.ingest("points", "twice", placed(2))
    again = feed.ingest("points", "twice", placed(2))
    assert (again.input, again.duplicate) == (first.input, True)
    before = feed.settle()
    feed.put("points", "twice", placed(2))
    after = feed.settle()
    assert after.refused["duplicate"] == before.refused.get("duplicate", 0) + 1  # type: ignore[call-overload, index]
    assert after.input == before.input
    assert sum(message.data == placed(2) for message in inputs_in(service.log)) == 1


def test_what_was_published_is_known_when_it_is_handed_in(both: Running) -> None:
    _, feed = both
    feed.put("points", "shown", placed(3))
    number = feed.settle().input
    receipt = feed.ingest("points", "shown", placed(3))
    assert (receipt.input, receipt.duplicate) == (number, True)


def test_the_same_bytes_of_another_robot_are_another_message(both: Running) -> None:
    _, feed = both
    first = feed.ingest("points", "left", placed(4))
    second = feed.ingest("points", "right", placed(4))
    assert not second.duplicate
    assert second.input == first.input + 1


@pytest.mark.parametrize("store", [False, True], ids=["by the log", "by the store"])
def test_duplicates_are_known_after_a_restart(tmp_path: Path, store: bool) -> None:
    """Three are remembered: of the robot that sent most the oldest is a new message again, and no other robot's."""
    settings: dict[str, Any] = {"input": {"duplicates": 3}}
    if store:
        settings["store"] = {"path": str(tmp_path / "map.db")}
    with Service(tmp_path, **settings) as service:
        with connected(service) as feed:
            numbers = [feed.ingest("points", "r1", placed(n)).input for n in range(4)]
        assert service.stop() == 0
    with Service(tmp_path, **settings) as service:
        endpoints = service.ready()["endpoints"]
        assert endpoints
        with connected(service) as feed:  # its greeting is the first message again, of another robot
            again = [feed.ingest("points", "r1", placed(n)) for n in (3, 2)]
            assert [(r.input, r.duplicate, r.epoch) for r in again] == [(n, True, 2) for n in (numbers[3], numbers[2])]
            fresh = feed.ingest("points", "r1", placed(1))
            assert (fresh.duplicate, fresh.input) == (False, numbers[3] + 1)
        assert service.stop() == 0
        assert replay(service.log)[0] == 0


def test_every_receipt_given_before_the_end_is_kept(tmp_path: Path) -> None:
    """Messages are on their way when the signal comes: each has its receipt and is logged, or is refused, or neither.

    What has a receipt was integrated too, being placed already; and the log is whole.
    """
    answers: Gathered[tuple[bytes, Receipt | str]] = Gathered()
    with Service(tmp_path) as service:
        with connected(service) as feed:
            for number in range(600):
                payload = placed(number)
                feed.send("points", "r1", payload, lambda answer, payload=payload: answers((payload, answer)))  # type: ignore[misc]
                if number == 100:
                    answers.wait(lambda items: len(items) >= 10, "the first receipts")
                    service.process.terminate()
            assert service.finished() == 0
        logged = inputs_in(service.log)
        receipts = [(payload, answer) for payload, answer in answers.items if isinstance(answer, Receipt)]
        assert len(receipts) >= 10
        assert all(logged[receipt.input - 1].data == payload for payload, receipt in receipts)
        assert {answer for _, answer in answers.items if isinstance(answer, str)} <= {"shutting_down"}
        code, verdict = replay(service.log)
        assert code == 0
        assert f"sequence {len(logged) - 1}," in verdict, "every cloud but the greeting's pose was integrated"


def test_a_log_that_cannot_be_written_for_a_while(tmp_path: Path) -> None:
    """The kernel lets the process write no file any more, as on a full disk, and then again.

    Meanwhile nothing is acknowledged or decided, queries go on, and the health says it; afterwards all is as before.
    """
    states: Gathered[str] = Gathered()
    with running(tmp_path) as (service, feed):
        feed.session.declare_subscriber(
            "maps/site/status", lambda s: states(MapStatus.model_validate_json(s.payload.to_bytes()).health)
        )
        sequence = feed.decided(feed.ingest("points", "r1", placed(0)).input).sequence
        limits = resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, (0, limits[1]))
        late: Gathered[Receipt | str] = Gathered()
        feed.send("points", "r1", placed(1), late)  # the one that meets the fault: kept, and written first
        assert late.wait(lambda items: len(items) == 1, "its refusal, at once") == ["log_unavailable"]
        assert feed.refused("points", "r1", placed(1)) == "log_unavailable", "nor the same bytes again"
        states.wait(lambda items: items[-1:] == ["degraded"], "the health to be degraded")
        assert feed.refused("points", "r1", placed(2)) == "log_unavailable"
        feed.put("points", "r1", placed(3))
        assert feed.refused("odometry", "r1", encode_odometry(T0, "map", (0, 0, 0), LEVEL)) == "log_unavailable"
        status = feed.client.status()
        assert (status.log.ok, status.refused["log_unavailable"]) == (False, 3)  # type: ignore[index]
        assert feed.client.region((0, -1, 3, 1)).known_cells > 0, "queries go on"
        assert status.sequence <= sequence + 1
        resource.prlimit(service.process.pid, resource.RLIMIT_FSIZE, limits)
        states.wait(lambda items: items[-1:] == ["ok"], "the health to be ok again")
        receipt = feed.ingest("points", "r1", placed(1))
        assert receipt.duplicate
        assert late.items == ["log_unavailable"], "a request has one answer"
        assert feed.decided(receipt.input).outcome == "integrated"
        assert feed.decided(feed.ingest("points", "r1", placed(2)).input).sequence == sequence + 2
        data = [message.data for message in inputs_in(service.log)]
        assert placed(1) in data
        assert placed(3) not in data
        assert len(list(service.log.glob("*.mcap"))) == 2, "it went on in a new file"
