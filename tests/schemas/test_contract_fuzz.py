"""Whatever bytes come in, nothing but the errors of the contract comes out."""

import contextlib

import pytest
from contract_tools import DECODERS, MESSAGES, many
from hypothesis import given
from hypothesis import strategies as st

from roughmap_schemas import (
    BadJson,
    CellAnswer,
    CellsQuery,
    Keys,
    MapStatus,
    MessageFault,
    QueryFault,
    Receipt,
    RegionQuery,
    RunMetadata,
    TileQuery,
    UnknownEventKind,
    decode_event,
    decode_grid,
    parse_model,
)

KEYS = Keys("site")


def decode(kind: str, payload: bytes) -> None:
    """Decode; what is taken has arrays that can be read to their last number."""
    with contextlib.suppress(MessageFault):
        got = DECODERS[kind](payload)
        if kind == "cloud":
            got.points.copy()
        elif kind == "grid":
            for layer in got.layers.values():
                layer.copy()


@pytest.mark.parametrize("kind", DECODERS)
@many
@given(payload=st.binary(max_size=200))
def test_arbitrary_bytes(kind: str, payload: bytes) -> None:
    decode(kind, payload)


@pytest.mark.parametrize("kind", DECODERS)
@many
@given(data=st.data())
def test_good_messages_with_bytes_changed(kind: str, data: st.DataObject) -> None:
    payload = bytearray(MESSAGES[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(payload) - 1))
        payload[at] = data.draw(st.integers(0, 255))
    decode(kind, bytes(payload))


@pytest.mark.parametrize("kind", DECODERS)
@many
@given(data=st.data())
def test_good_messages_with_pieces_moved(kind: str, data: st.DataObject) -> None:
    """Cut out, doubled, and joined with pieces of messages of other kinds."""
    payload, other = MESSAGES[kind], MESSAGES[data.draw(st.sampled_from(sorted(MESSAGES)))]
    places = st.integers(0, len(payload))
    a, b = sorted((data.draw(places), data.draw(places)))
    c = data.draw(st.integers(0, len(other)))
    decode(
        kind,
        data.draw(st.sampled_from([payload[:a] + payload[b:], payload[:b] + payload[a:], payload[:a] + other[c:]])),
    )


@many
@given(st.binary(max_size=100))
def test_a_grid_of_any_compressed_data(data: bytes) -> None:
    payload = MESSAGES["grid"] + b"\x4a" + bytes([len(data)]) + data  # field 9, data: the last one holds
    with contextlib.suppress(MessageFault):
        decode_grid(payload, "zstd", max_data=1 << 16)


words = st.sampled_from(
    [
        "layers",
        "bbox",
        "since",
        "epoch",
        "limits",
        "level",
        "x",
        "y",
        "=",
        ";",
        ",",
        ":",
        "1",
        "-1",
        "1e9",
        "nan",
        "_t",
        " ",
    ]
)
selectors = st.text(max_size=40) | st.lists(words, max_size=12).map("".join)


@many
@given(selectors, st.binary(max_size=40))
def test_any_selector(text: str, payload: bytes) -> None:
    for parse in (TileQuery.parse, lambda t: RegionQuery.parse(t, 8), lambda t: CellsQuery.parse(t, payload)):
        with contextlib.suppress(QueryFault):
            parse(text)


chunks = st.sampled_from(
    ["maps", "site", "tiles", "updates", "0", "-0", "1", "99999999999", "*", "**", "robots", "r", "points"]
)


@many
@given(st.text(max_size=30) | st.lists(chunks, max_size=7).map("/".join))
def test_any_key(key: str) -> None:
    with contextlib.suppress(QueryFault):
        KEYS.parse_tile_selector(key)
    for parse_robot in (KEYS.parse_points, KEYS.parse_odometry, KEYS.parse_transform, KEYS.parse_ingest):
        with contextlib.suppress(MessageFault):
            parse_robot(key)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["kind", "input", "epoch"]), inner),
    max_leaves=6,
)


@many
@given(st.binary(max_size=60) | json_values.map(lambda value: repr(value).replace("'", '"').encode()))
def test_any_json(payload: bytes) -> None:
    with contextlib.suppress(BadJson, UnknownEventKind):
        decode_event(payload)
    for kind in (Receipt, CellAnswer, MapStatus):
        with contextlib.suppress(BadJson):
            parse_model(kind, payload)


@many
@given(st.dictionaries(st.sampled_from(list(RunMetadata.model_fields)), st.text(max_size=10) | st.just("1")))
def test_any_metadata_record(record: dict[str, str]) -> None:
    with contextlib.suppress(BadJson):
        RunMetadata.from_record(record)


@pytest.mark.parametrize("payload", [b"[" * 100_000, b'{"kind":' * 100_000, b'{"kind": ' + b"9" * 10_000 + b"}"])
def test_deep_and_long_json(payload: bytes) -> None:
    with pytest.raises(BadJson):
        decode_event(payload)
    with pytest.raises(BadJson):
        parse_model(Receipt, payload)
