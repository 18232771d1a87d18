"""Log lines: for programs and for people, and repeats counted."""

import io
import json
import logging
import os
from collections.abc import Iterator

import pytest

from roughmap_schemas import Config, MessageFault
from roughmap_schemas.kinds import Kind
from roughmap_schemas.messages import MapStatus
from roughmap_service.host.counters import OTHERS, REFUSED_ROBOTS, Counters
from roughmap_service.host.log_lines import (
    MAX_KINDS,
    REPEAT_SECONDS,
    REPEATS,
    JsonFormatter,
    Lines,
    TextFormatter,
    note,
    set_up,
)
from roughmap_service.inputs import admission
from roughmap_service.inputs.admission import refuse
from roughmap_service.inputs.streams import Streams
from roughmap_service.watch.status import Overload


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    made = logging.Logger("under test")
    yield made
    for handler in list(made.handlers):
        handler.close()


def lines_to(logger: logging.Logger, formatter: logging.Formatter) -> tuple[io.StringIO, Clock]:
    stream, clock = io.StringIO(), Clock()
    handler = Lines(stream, clock)
    handler.setFormatter(formatter)
    logger.addHandler(handler)
    return stream, clock


def test_a_json_line_has_the_event_and_its_values(logger: logging.Logger) -> None:
    stream, _ = lines_to(logger, JsonFormatter())
    note(logger, logging.INFO, "rotated", "the log\ngoes on", file="b.mcap", message="not this one")
    try:
        raise OSError("no room")
    except OSError:
        logger.exception("failed with %d", 7)
    first, second = (json.loads(line) for line in stream.getvalue().splitlines())
    assert first.pop("time").endswith("+00:00")
    assert first == {"level": "info", "event": "rotated", "message": "the log\ngoes on", "file": "b.mcap"}
    assert (second["level"], second["message"]) == ("error", "failed with 7")
    assert "OSError: no room" in second["error"]


def test_a_text_line_is_for_reading(logger: logging.Logger) -> None:
    stream, _ = lines_to(logger, TextFormatter())
    note(logger, logging.WARNING, "gap", "robot r1: 3 are missing", robot="r1")
    assert stream.getvalue().split(maxsplit=1)[1] == "WARNING robot r1: 3 are missing\n"


def test_repeats_are_counted_and_told_with_the_next_line(logger: logging.Logger) -> None:
    stream, clock = lines_to(logger, TextFormatter())
    for number in range(100):
        note(logger, logging.WARNING, "gap", f"gap {number}", robot="r1")
    note(logger, logging.WARNING, "gap", "another robot's", robot="r2")
    logger.warning("another kind")
    clock.now = REPEAT_SECONDS
    note(logger, logging.WARNING, "gap", "gap 100", robot="r1")
    told = [line.split(" WARNING ")[1] for line in stream.getvalue().splitlines()]
    few = [f"gap {number}" for number in range(REPEATS)]
    assert told == [*few, "another robot's", "another kind", f"gap 100 (and {100 - REPEATS} more like it before)"]


def test_each_robot_s_first_refusal_of_a_kind_is_reported_and_a_flood_of_names_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    logger = logging.getLogger(admission.__name__)
    monkeypatch.setattr(logger, "handlers", [])
    stream, _ = lines_to(logger, JsonFormatter())
    counters, streams = Counters(), Streams(Config())
    for _ in range(REPEATS + 1):
        refuse(counters, streams, "r1", Kind.POINTS, MessageFault("unknown_sensor", "frame 'sonar'"))
    refuse(counters, streams, "r1", Kind.POINTS, MessageFault("bad_message", "no cloud"))
    refuse(counters, streams, "r2", Kind.POINTS, MessageFault("unknown_sensor", "frame 'radar'"))
    refuse(counters, streams, OTHERS, Kind.POINTS, MessageFault("bad_key", "x" * 10_000))
    told = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [(line["robot"], line["reason"]) for line in told] == [
        *[("r1", "unknown_sensor")] * REPEATS, ("r1", "bad_message"), ("r2", "unknown_sensor"), (OTHERS, "bad_key")
    ]  # fmt: skip
    assert told[0]["message"] == "robot r1: message refused, unknown_sensor: frame 'sonar'"
    assert len(told[-1]["message"]) < 1000
    for number in range(2 * MAX_KINDS):
        refuse(counters, streams, f"flood{number}", Kind.POINTS, MessageFault("unknown_robot", "not in input.robots"))
    assert len(stream.getvalue().splitlines()) <= len(told) + REFUSED_ROBOTS + REPEATS
    assert counters.snapshot().refused["unknown_robot"] == 2 * MAX_KINDS


def test_what_was_counted_last_is_reported_at_the_end(logger: logging.Logger) -> None:
    stream, _ = lines_to(logger, JsonFormatter())
    for number in range(REPEATS + 2):
        logger.error("fault %d", number)
    logger.handlers[0].close()
    told = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["message"] for line in told] == [f"fault {n}" for n in (*range(REPEATS), REPEATS + 1)]
    assert told[-1]["repeats"] == 1


def test_a_state_that_is_entered_or_left_is_always_reported(logger: logging.Logger) -> None:
    stream, _ = lines_to(logger, TextFormatter())
    for _ in range(10):
        note(logger, logging.WARNING, "degraded", "down", always=True)
        note(logger, logging.WARNING, "recovered", "up", always=True)
    assert len(stream.getvalue().splitlines()) == 20


def test_kinds_that_are_remembered_are_bounded(logger: logging.Logger) -> None:
    """The oldest is forgotten: it begins again, and may be told as often as a new one."""
    stream, _ = lines_to(logger, TextFormatter())

    def told(robot: str) -> int:
        before = len(stream.getvalue().splitlines())
        for _ in range(2 * REPEATS):
            note(logger, logging.INFO, "robot", "line", robot=robot)
        return len(stream.getvalue().splitlines()) - before

    assert [told(f"r{number}") for number in range(MAX_KINDS)] == [REPEATS] * MAX_KINDS
    assert told("r0") == 0
    assert told("one more") == REPEATS
    assert told("r1") == 0
    assert told("r0") == REPEATS


def test_the_form_follows_the_terminal_and_the_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    root = logging.RootLogger(logging.WARNING)
    monkeypatch.setattr(logging, "root", root)

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    for log_format, stream, as_json in (
        ("auto", io.StringIO(), True), ("auto", Terminal(), False), ("json", Terminal(), True),
        ("text", io.StringIO(), False),
    ):  # fmt: skip
        set_up(log_format, "warning", stream)  # type: ignore[arg-type]
        root.info("not this")
        root.warning("this")
        assert stream.getvalue().startswith("{") == as_json
        assert len(stream.getvalue().splitlines()) == 1


def test_an_overload_is_reported_when_it_begins_and_ends(caplog: pytest.LogCaptureFixture, status: MapStatus) -> None:
    overload = Overload()
    with caplog.at_level(logging.INFO):
        for subjects, dropped in (
            ((), 5),
            (("overload",), 8),
            (("overload", "robot r1"), 20),
            (("overload", "log"), 25),
            (("robot r1",), 30),
            ((), 30),
        ):
            clouds = status.clouds.model_copy(update={"rejected": {"overload": dropped}})
            problems = dict.fromkeys(subjects, "as the test wants it")
            overload.watch(status.model_copy(update={"problems": problems, "clouds": clouds}))
    assert [record.event for record in caplog.records] == ["overload_begun", "overload_ended"]  # type: ignore[attr-defined]
    assert caplog.records[1].fields == {"dropped": 25}  # type: ignore[attr-defined]


@pytest.fixture
def status() -> MapStatus:
    return MapStatus(
        map="site", run="0" * 32, instance="1" * 32, epoch=1, version="1", frame_id="map", cell_size=0.1, levels=8,
        layers=[], bounds=None, extent=None, error_model="cuboid", configuration_digest="2" * 32, health="ok",
        sequence=0, durable_sequence=0, input=0, newest_stamp_ns=0, clouds={}, points={}, poses={}, refused={}, gaps={},
        jumps={}, lag_s={}, rates={}, memory_bytes=0, tiles={}, log={}, uptime_s=1.0,
    )  # fmt: skip


def test_a_reader_that_stops_reading_the_lines_blocks_nothing(logger: logging.Logger) -> None:
    """They are lost, and counted when there is a reader again."""
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb", buffering=0) as reader, os.fdopen(writing, "w", encoding="utf-8") as stream:
        handler = Lines(stream)
        handler.setFormatter(TextFormatter())
        logger.addHandler(handler)
        for n in range(2000):  # a pipe takes 64 KiB
            note(logger, logging.INFO, "line", f"line {n} {'.' * 100}", always=True)
        taken = reader.read(1 << 20)
        note(logger, logging.INFO, "line", "the end", always=True)
        lost, end = reader.read(1 << 20).decode().splitlines()
        assert lost.endswith(f"WARNING {2000 - taken.count(b'INFO line')} log lines are lost: stderr was blocked")
        assert end.endswith("INFO the end")
