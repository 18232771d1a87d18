"""Every way in which a tile query is refused: one error reply with its code, and nothing else."""

import threading
from collections.abc import Iterator

import pytest
import zenoh
from asking_raw import get
from net import Gathered, wait_for
from served import Served

from roughmap_schemas.messages import QueryRecord


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with Served(settings={"query": {"max_reply_tiles": 10}}) as served:
        yield served


@pytest.mark.parametrize(
    ("selector", "code"),
    [
        ("0/00/0", "bad_key"),
        ("0/01/0", "bad_key"),
        ("0/-0/0", "bad_key"),
        ("0/+1/0", "bad_key"),
        ("0/0/1.0", "bad_key"),
        ("0/0/1e3", "bad_key"),
        ("0/0x1/0", "bad_key"),
        ("0/one/0", "bad_key"),
        ("0/2147483648/0", "bad_key"),
        ("0/0/-2147483649", "bad_key"),
        ("00/0/0", "bad_key"),
        ("0/\u0661/0", "bad_key"),
        ("8/0/0", "bad_level"),
        ("-1/0/0", "bad_level"),
        ("2147483647/*/*", "bad_level"),
        ("0/0/0?layer=range", "unknown_parameter"),
        ("0/0/0?level=0", "unknown_parameter"),
        ("0/0/0?Layers=range", "unknown_parameter"),
        ("0/0/0?layers", "bad_parameter"),
        ("0/0/0?=1", "bad_parameter"),
        ("0/0/0?layers=range;;tolerance=1", "bad_parameter"),
        ("0/0/0?layers=range;layers=range", "bad_parameter"),
        ("0/0/0?layers=range,range", "bad_parameter"),
        ("0/0/0?layers=range, count", "bad_parameter"),
        ("0/0/0?since=1", "bad_parameter"),
        ("0/0/0?since=-1;epoch=5", "bad_parameter"),
        ("0/0/0?since=1;epoch=five", "bad_parameter"),
        ("0/0/0?since=01;epoch=5", "bad_parameter"),
        ("0/0/0?tolerance=0", "bad_parameter"),
        ("0/0/0?tolerance=nan", "bad_parameter"),
        ("0/0/0?tolerance=1_0", "bad_parameter"),
        ("0/0/0?limits=slope", "bad_parameter"),
        ("0/0/0?limits=slope:0", "bad_parameter"),
        ("0/0/0?limits=slope:1,slope:1", "bad_parameter"),
        ("0/0/0?limits=depth:1", "bad_parameter"),
        ("0/0/0?dtype=f2", "bad_parameter"),
        ("0/0/0?compression=lz4", "bad_parameter"),
        ("0/0/0?layers=height", "unknown_layer"),
        ("0/0/0?layers=mean_height,", "unknown_layer"),
        ("0/*/*?bbox=0,0,1", "bad_bbox"),
        ("0/*/*?bbox=0,0,1,1,1", "bad_bbox"),
        ("0/*/*?bbox=1,0,0,1", "bad_bbox"),
        ("0/*/*?bbox=0,0,0,1", "bad_bbox"),
        ("0/*/*?bbox=0,0,inf,1", "bad_bbox"),
        ("0/*/*?bbox=0,0,nan,1", "bad_bbox"),
        ("0/*/*?bbox=0,0,1,1e999", "bad_bbox"),
        ("0/*/*?bbox=", "bad_bbox"),
        ("0/*/*?bbox=0, 0,1,1", "bad_bbox"),
        ("0/*/*?since=6;epoch=5", "since_ahead"),
        ("0/77/77?since=9223372036854775808;epoch=5", "since_ahead"),
        ("0/*/*", "too_large"),
        ("**", "too_large"),
        (f"0/0/0?limits={'slope:1,' * 10000}", "too_large"),
    ],
)
def test_refusals(served: Served, selector: str, code: str) -> None:
    assert get(served.asker, f"maps/site/tiles/{selector}").error() == code


@pytest.mark.parametrize("key", ["maps/site/tiles/0/0", "maps/site/tiles/0/0/0/0", "maps/site/tile/0/0/0"])
def test_keys_of_another_form_reach_nobody(served: Served, key: str) -> None:
    replies = get(served.asker, key)
    assert (replies.ok, replies.errors) == ([], [])


def test_names_of_zenoh_are_left_alone(served: Served) -> None:
    found = get(served.asker, "maps/site/tiles/0/0/0?_anyke;layers=range;_time=[now()..]").tiles()
    assert set(found) == {(0, 0, 0)}


def test_as_many_tiles_as_allowed_are_answered(served: Served) -> None:
    assert len(get(served.asker, "maps/site/tiles/0/*/*?bbox=-12.8,-6.4,12.8,6.4").tiles()) == 8
    assert get(served.asker, "maps/site/tiles/0/*/*?bbox=-12.8,-6.4,12.9,12.8").error() == "too_large"


def test_a_refusal_is_recorded_in_the_log(served: Served) -> None:
    selector = "maps/site/tiles/0/0/0?layers=height;dtype=f8"
    assert get(served.asker, selector).error() == "unknown_layer"

    def told() -> list[QueryRecord]:  # records of earlier tests may still be on their way
        return [record for record in served.records if record.selector == selector]

    with served.recorded:
        assert served.recorded.wait_for(lambda: bool(told()), 30.0)
    (record,) = told()
    assert record == QueryRecord(
        selector=selector, tiles=0, sequence=0, duration_ns=record.duration_ns,
        outcome="unknown_layer",
    )  # fmt: skip


def ask_later(session: zenoh.Session, selector: str) -> Gathered[zenoh.Reply]:
    """Asks without waiting for the replies."""
    gathered: Gathered[zenoh.Reply] = Gathered()
    session.get(selector, gathered, consolidation=zenoh.ConsolidationMode.NONE, timeout=60.0)
    return gathered


def test_busy_and_shutting_down() -> None:
    """One worker, held up by a status that does not come, and one place to wait."""
    entered, go_on = threading.Event(), threading.Event()
    made = Served(settings={"query": {"workers": 1, "queue_limit": 1}})

    def held_up() -> None:
        entered.set()
        wait_for(go_on, "leave to answer")
        raise ValueError("a status that can't be made")

    made.status = held_up  # type: ignore[assignment]
    with made as served:
        running = ask_later(served.asker, "maps/site/status")
        wait_for(entered, "the status to be asked for")
        waiting = ask_later(served.asker, "maps/site/tiles/0/0/0")
        # Queries of one session come in order: when this one is refused, the one before it waits.
        assert get(served.asker, "maps/site/tiles/0/1/0").error() == "busy"
        closing = threading.Thread(target=served.answers.close)
        closing.start()
        try:
            (refused,) = waiting.wait(lambda replies: len(replies) == 1, "the refusal of what waited")
            assert refused.err is not None
            assert b'"shutting_down"' in refused.err.payload.to_bytes()
        finally:
            go_on.set()
            closing.join()
        (reply,) = running.wait(lambda replies: len(replies) == 1, "the answer of what ran")
        assert reply.err is not None
        assert b'"internal"' in reply.err.payload.to_bytes()


def test_after_an_error_within_the_service_others_are_answered() -> None:
    made = Served(settings={"query": {"workers": 1}})
    faults = [ValueError("no status today"), MemoryError()]
    made.status = lambda: (_ for _ in ()).throw(faults.pop(0))
    with made as served:
        assert get(served.asker, "maps/site/status").error() == "internal"
        assert get(served.asker, "maps/site/status").error() == "too_large"
        assert set(get(served.asker, "maps/site/tiles/0/0/0").tiles()) == {(0, 0, 0)}
