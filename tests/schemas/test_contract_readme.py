"""schemas/README.md names everything that the contract has, and its samples are what the code writes and reads."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from roughmap_schemas import (
    CONTRACT_VERSION,
    LAYERS,
    LIMIT_NAMES,
    CellAnswer,
    CellsQuery,
    CellState,
    CloudReason,
    Config,
    ControlAnswer,
    MapStatus,
    PointReason,
    PoseReason,
    QueryCode,
    QueryError,
    Receipt,
    Refusal,
    RegionQuery,
    RunMetadata,
    TileInfo,
    TileQuery,
    decode_event,
    encode_cloud,
    encode_grid,
    encode_odometry,
    encodings,
    events,
    parse_model,
)
from roughmap_schemas.keys import TEMPLATES
from roughmap_schemas.kinds import Kind
from roughmap_schemas.messages import Message
from roughmap_schemas.parameters import MAX_TEXT
from roughmap_schemas.run_metadata import CHECKSUM
from roughmap_schemas.selectors import MAX_PLACES_TEXT, MAX_POINTS
from roughmap_schemas.transform import MAX_FRAME
from roughmap_schemas.wire import MAX_ENTRIES

PAGE = (Path(__file__).parents[2] / "schemas" / "README.md").read_text(encoding="utf-8")

MODELS = (CellAnswer, CellState, ControlAnswer, MapStatus, QueryError, Receipt, TileInfo)
STAMP_NS = 1_700_000_000 * 10**9


def table(head: str) -> list[list[str]]:
    """The rows of the table whose first column is headed so, in order."""
    (found,) = re.findall(rf"^\| {re.escape(head)} \|.*\n\|[-|]+\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in found.splitlines()]


def names(head: str) -> list[str]:
    """The first column, without its marks."""
    return [row[0].strip("`") for row in table(head)]


def samples(kind: str) -> dict[str, str]:
    """The fenced blocks of a language, by what stands behind it."""
    return dict(re.findall(rf"^```{kind} (\w+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))


def test_the_version() -> None:
    assert f"# The contract, version {CONTRACT_VERSION}\n" in PAGE


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("point", list(PointReason)),  # in the order in which they are tried
        ("layer", list(LAYERS)),
        ("limit", [*LIMIT_NAMES["all"], *(name for name in LIMIT_NAMES["ground"] if name not in LIMIT_NAMES["all"])]),
        ("kind", list(events.KINDS)),
        ("cloud", list(CloudReason)),
        ("pose", list(PoseReason)),
        ("refused", list(Refusal)),
        ("code", list(QueryCode)),
        ("name", list(TEMPLATES)),
        ("entry", [*RunMetadata.model_fields, CHECKSUM]),
        *((f"member of {model.__name__}", list(model.model_fields)) for model in MODELS),
    ],
)
def test_tables_are_complete(head: str, words: list[str]) -> None:
    assert names(head) == words


def test_members_of_members() -> None:
    rows = {row[0].strip("`"): row[-1] for row in table("member of MapStatus")}
    for name, field in MapStatus.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Message):
            for member in field.annotation.model_fields:
                assert f"`{member}`" in rows[name], f"{name}.{member}"
    entry = PAGE[PAGE.index("Each entry has `x`") :].partition("\n\n")[0]
    for member in ("x", "y", "i", "j", "state", "layers"):
        assert f"`{member}`" in entry
    for row, kind in zip(
        table("kind"),
        (
            events.IntegrationEvent,
            events.CheckpointEvent,
            events.ResetEvent,
            events.ForgetEvent,
            events.SensorTimeEvent,
        ),
        strict=True,
    ):
        assert set(kind.model_fields) - {"kind"} <= set(re.findall(r"`(\w+)`", row[1]))


def test_parameters() -> None:
    rows = table("parameter")
    for column, query in enumerate((TileQuery, RegionQuery, CellsQuery), 1):
        fields = {field.name for field in dataclasses.fields(query)}
        if query is CellsQuery:
            fields = fields - {"points"} | {"x", "y"}
        assert {row[0].strip("`") for row in rows if row[column] == "yes"} == fields
        assert all(row[column] in {"yes", "no"} for row in rows)


def test_keys_and_encodings() -> None:
    assert {row[0].strip("`"): row[1].strip("`") for row in table("name")} == TEMPLATES
    written = {row[1].partition(",")[0].strip("`") for row in table("payload")}
    assert written == {
        encodings.POINT_CLOUD, encodings.ODOMETRY, encodings.FRAME_TRANSFORM, encodings.GRID,
        encodings.json_encoding("NAME"),
    }  # fmt: skip


def test_numbers() -> None:
    config = Config().model_dump()
    for row in table("setting"):
        section, _, name = row[0].strip("`").partition(".")
        assert float(row[1]) == config[section][name], row[0]
    fixed = PAGE[PAGE.index("\nFixed: ") :].partition("\n\n")[0]
    for text in (
        f"{MAX_POINTS:,} places", f"{MAX_PLACES_TEXT >> 20} MiB", f"{MAX_TEXT:,} bytes of parameters",
        f"{MAX_ENTRIES}\nprotobuf entries", f"{MAX_FRAME} characters",
    ):  # fmt: skip
        assert text in fixed


def test_topics() -> None:
    assert len(table("topic")) == len(Kind), "one row each"


@pytest.mark.parametrize("model", [model for model in MODELS if model is not CellState])
def test_json_samples(model: type[Message]) -> None:
    text = samples("json")[model.__name__]
    assert list(json.loads(text)) == list(model.model_fields)
    parsed = parse_model(model, text)
    assert json.loads(parsed.model_dump_json()) == json.loads(text)


def test_an_events_sample() -> None:
    decode_event(samples("json")["Event"].encode())


def test_bytes() -> None:
    payloads = {
        "PointCloud": encode_cloud(
            np.array([[1, 2, 0.5]], np.float32), STAMP_NS + 20_000_000, "lidar", offsets_ns=[1000]
        ),
        "Odometry": encode_odometry(STAMP_NS, "map", (1, 2, 0.5), (0, 0, 0, 1)),
        "Grid": encode_grid(
            {"mean_height": np.array([[1.0, np.nan]]), "count": np.array([[3.0, 0.0]])},
            (-0.1, 0.2),
            0.1,
            STAMP_NS,
            "map",
        ),
    }
    shown = samples("hex")
    assert set(shown) == set(payloads)
    for name, text in shown.items():
        assert bytes.fromhex("".join(line.partition("   ")[0] for line in text.splitlines())) == payloads[name], name
