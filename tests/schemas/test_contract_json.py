"""JSON: messages, events and the metadata of a run, there and back."""

import json
import math

import pytest
from contract_tools import few
from hypothesis import given
from hypothesis import strategies as st
from json_samples import CHECKPOINT, DIGEST, EVENTS, HEX, INTEGRATION, METADATA, SAMPLES, STATE, STATUS, TILE
from pydantic import ValidationError

from roughmap_schemas import (
    CONTRACT_VERSION,
    BadJson,
    CellEntry,
    CellState,
    CloudReason,
    MapStatus,
    PointReason,
    PoseReason,
    QueryCode,
    Receipt,
    Refusal,
    RunMetadata,
    TileInfo,
    UnknownEventKind,
    decode_event,
    encode_event,
    model_bytes,
    parse_model,
)
from roughmap_schemas.contract import is_compatible
from roughmap_schemas.reasons import MEANING


@pytest.mark.parametrize("name", SAMPLES)
def test_messages_there_and_back(name: str) -> None:
    sample = SAMPLES[name]
    assert parse_model(type(sample), model_bytes(sample)) == sample


@pytest.mark.parametrize("name", SAMPLES)
def test_unknown_missing_and_foreign_members(name: str) -> None:
    """What a later minor release adds is ignored; what this one has must be there."""
    kind, values = type(SAMPLES[name]), json.loads(model_bytes(SAMPLES[name]))
    assert parse_model(kind, json.dumps({**values, "more": 1})) == SAMPLES[name]
    first = next(name for name, field in kind.model_fields.items() if field.is_required())
    with pytest.raises(BadJson, match=f"{name} in JSON: {first}"):
        parse_model(kind, json.dumps({key: value for key, value in values.items() if key != first}))
    for payload in (b"", b"[]", b"null", b"{", b"\xff"):
        with pytest.raises(BadJson):
            parse_model(kind, payload)


@pytest.mark.parametrize("name", SAMPLES)
def test_json_never_holds_nan(name: str) -> None:
    def never(word: str) -> None:
        raise AssertionError(f"{word} in JSON")

    json.loads(model_bytes(SAMPLES[name]), parse_constant=never)


def test_the_members_that_the_contract_names() -> None:
    assert list(MapStatus.model_fields) == list(STATUS)
    assert list(TileInfo.model_fields) == list(TILE)
    assert list(CellState.model_fields) == list(STATE)
    answer = json.loads(model_bytes(SAMPLES["CellAnswer"]))
    assert list(answer) == ["contract", "map", "instance", "epoch", "sequence", "cells"]
    assert list(CellEntry.model_fields) == ["x", "y", "i", "j", "state", "layers"]
    assert json.loads(model_bytes(Receipt(input=1, epoch=2))) == {
        "contract": CONTRACT_VERSION,
        "input": 1,
        "epoch": 2,
        "durable": True,
        "duplicate": False,
    }
    assert json.loads(model_bytes(SAMPLES["ControlAnswer"])) == {
        "contract": CONTRACT_VERSION,
        "sequence": 4,
        "epoch": 2,
        "tiles": 6,
    }
    assert json.loads(encode_event(INTEGRATION)) == {
        "kind": "integration",
        "epoch": 2,
        "input": 9,
        "robot": "r1",
        "poses": [[7, 0], [8, 3]],
        "outcome": "integrated",
        "accepted": 5,
        "rejected": {"range": 2, "time": 1},
        "sequence": 4,
        "cleared": 8,
    }
    assert json.loads(encode_event(CHECKPOINT)) == {"kind": "checkpoint", "epoch": 2, "sequence": 4, "digest": DIGEST}


@pytest.mark.parametrize("member", ["clouds", "points", "poses", "refused"])
def test_a_reason_of_a_later_release_is_read_as_text(member: str) -> None:
    values = json.loads(model_bytes(SAMPLES["MapStatus"]))
    counts = values["refused"] if member == "refused" else values[member]["rejected"]
    counts["later"] = 3
    status = parse_model(MapStatus, json.dumps(values))
    read = status.refused if member == "refused" else getattr(status, member).rejected
    assert read == counts
    assert json.loads(model_bytes(status)) == values


@pytest.mark.parametrize("name", ["CellAnswer", "ControlAnswer", "MapStatus", "QueryError", "Receipt", "TileInfo"])
def test_every_reply_begins_with_its_contract(name: str) -> None:
    values = json.loads(model_bytes(SAMPLES[name]))
    assert next(iter(values.items())) == ("contract", CONTRACT_VERSION)
    for wrong in ("1", "one", "1.0.0", 1.0, None):
        with pytest.raises(BadJson, match="contract"):
            parse_model(type(SAMPLES[name]), json.dumps({**values, "contract": wrong}))
    old = {name: value for name, value in values.items() if name != "contract"}
    assert "contract" not in parse_model(type(SAMPLES[name]), json.dumps(old)).model_fields_set


@pytest.mark.parametrize(("version", "good"), [("1.0", True), ("1.17", True), ("2.0", False), ("10.0", False)])
def test_versions_of_one_major_understand_each_other(version: str, good: bool) -> None:
    assert is_compatible(version) == good


@few
@given(st.floats())
def test_a_layer_that_is_not_known_is_null(value: float) -> None:
    entry = CellEntry(x=0.0, y=0.0, i=0, j=0, state=None, layers={"std_dev": value})
    written = json.loads(model_bytes(entry))["layers"]["std_dev"]
    assert written == (value if math.isfinite(value) else None)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_cells_state_is_finite(value: float) -> None:
    with pytest.raises(ValidationError):
        CellState(**{**STATE, "mean": value})


def test_a_receipt_is_durable() -> None:
    with pytest.raises(BadJson, match="durable"):
        parse_model(Receipt, b'{"input": 1, "epoch": 1, "durable": false, "duplicate": false}')
    with pytest.raises(BadJson, match="input"):
        parse_model(Receipt, b'{"input": 0, "epoch": 1}')


def test_the_reasons_of_the_contract() -> None:
    points = "not_finite no_return duplicate_return time no_pose self range ceiling covariance uncertain bounds"
    assert " ".join(PointReason) == points
    assert set(CloudReason) == {
        *("pose_gap", "pose_jump", "no_pose", "late", "too_many_tiles", "empty", "overload", "clock_reset"),
        *("clock_offset", "time_form", "no_extrinsics"),
    }
    assert set(PoseReason) == {
        *("duplicate", "stale", "ahead", "out_of_order", "frozen", "pose_frame", "bad_covariance")
    }
    assert set(QueryCode) == {
        *("bad_key", "bad_level", "unknown_parameter", "bad_parameter", "unknown_layer", "bad_bbox", "too_large"),
        *("since_ahead", "busy", "shutting_down", "internal"),
    }
    refusals = {"bad_key", "bad_encoding", "bad_message", "too_large", "unknown_sensor", "unknown_robot", "busy"}
    # `duplicate` counts published messages that the log has already; it is never answered.
    assert set(Refusal) == refusals | {"unset_stamp", "log_unavailable", "shutting_down", "duplicate"}
    for kind in (PointReason, CloudReason, PoseReason, Refusal):
        assert set(MEANING[kind]) == set(kind), "each is explained"


@pytest.mark.parametrize("event", EVENTS, ids=lambda event: event.kind)
def test_events_there_and_back(event: object) -> None:
    assert decode_event(encode_event(event)) == event


@pytest.mark.parametrize("reason", CloudReason)
def test_a_rejected_clouds_event(reason: CloudReason) -> None:
    event = INTEGRATION.model_copy(update={"outcome": reason, "poses": [], "accepted": 0, "rejected": {}})
    assert decode_event(encode_event(event)) == event


@pytest.mark.parametrize("kind", ["edit", "remap", "", "Integration", "x" * 100])
def test_a_reader_stops_at_a_kind_that_it_does_not_know(kind: str) -> None:
    with pytest.raises(UnknownEventKind) as caught:
        decode_event(json.dumps({"kind": kind, "epoch": 1}).encode())
    assert caught.value.kind == kind


@pytest.mark.parametrize(
    "change",
    [
        {"outcome": "lost"},
        {"rejected": {"unlucky": 1}},
        {"rejected": {"range": -1}},
        {"input": 0},
        {"poses": [[0, 0]]},
        {"poses": [[1]]},
        {"sequence": None},
        {"accepted": 1.5},
        {"more": 1},
    ],
)
def test_events_that_cannot_be(change: dict) -> None:
    values = {**json.loads(encode_event(INTEGRATION)), **change}
    with pytest.raises(BadJson, match=next(iter(change))):
        decode_event(json.dumps(values).encode())


@pytest.mark.parametrize(
    "payload", [b"", b"{}", b"[]", b'{"kind": 5}', b'{"kind": null}', b'{"kind": "checkpoint"}', b"\xff"]
)
def test_what_is_no_event(payload: bytes) -> None:
    with pytest.raises(BadJson, match="expected an Event"):
        decode_event(payload)


def test_a_runs_metadata_there_and_back() -> None:
    metadata = RunMetadata.model_validate(METADATA)
    record = metadata.to_record()
    assert all(isinstance(value, str) for value in record.values())
    assert (record["run"], record["first_input"]) == (HEX, "1")
    assert RunMetadata.from_record(record) == metadata
    with pytest.raises(BadJson, match="checksum"):
        RunMetadata.from_record({**record, "epoch": "9"})
    unchecked = {name: value for name, value in record.items() if name != "checksum"}
    assert RunMetadata.from_record({**unchecked, "later": "entry"}) == metadata
    without = metadata.model_copy(update={"base_digest": ""})
    assert RunMetadata.from_record(without.to_record()) == without


def test_metadata_of_a_release_before_the_rules_had_a_number() -> None:
    record = RunMetadata.model_validate(METADATA).to_record()
    del record["rules"], record["state_version"], record["checksum"]
    assert (RunMetadata.from_record(record).rules, RunMetadata.from_record(record).state_version) == (1, 1)


@pytest.mark.parametrize("name", [name for name in RunMetadata.model_fields if name not in ("rules", "state_version")])
def test_metadata_that_lacks_an_entry_or_has_a_wrong_one(name: str) -> None:
    record = RunMetadata.model_validate(METADATA).to_record()
    with pytest.raises(BadJson, match=name):
        RunMetadata.from_record({key: value for key, value in record.items() if key != name})
    if name != "version":  # any text is one
        with pytest.raises(BadJson, match=name):
            RunMetadata.from_record({**record, name: "-1"})
