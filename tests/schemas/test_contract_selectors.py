"""The parameters of queries: each of them, and each code that reading them can give."""

import json

import pytest
from contract_tools import finite, many
from hypothesis import given
from hypothesis import strategies as st

from roughmap_schemas import LAYERS, LIMIT_NAMES, CellsQuery, ForgetQuery, QueryFault, RegionQuery, TileQuery
from roughmap_schemas.parameters import parse_parameters

BBOX = "bbox=0,0,1,1"
positive = st.floats(min_value=5e-324, allow_infinity=False)
boxes = st.tuples(finite, finite, finite, finite).filter(lambda b: b[0] < b[2] and b[1] < b[3])
looks = {
    "layers": st.lists(st.sampled_from(LAYERS), min_size=1, unique=True).map(tuple),
    "tolerance": st.none() | positive,
    "limits": st.none()
    | st.dictionaries(st.sampled_from(sorted({*LIMIT_NAMES["all"], *LIMIT_NAMES["ground"]})), positive, min_size=1),
}
grids = {**looks, "dtype": st.sampled_from(["f4", "f8"]), "compression": st.sampled_from([None, "zstd"])}
counts = st.integers(0, 10**18)
since = st.none() | st.tuples(counts, counts)


@many
@given(st.fixed_dictionaries({**grids, "bbox": st.none() | boxes}), since)
def test_tile_queries_there_and_back(values: dict, known: tuple[int, int] | None) -> None:
    seq, epoch = known if known is not None else (None, None)
    query = TileQuery(**values, since=seq, epoch=epoch)
    assert TileQuery.parse(query.format()) == query


@many
@given(st.fixed_dictionaries({**grids, "bbox": boxes, "level": st.integers(0, 7)}))
def test_region_queries_there_and_back(values: dict) -> None:
    query = RegionQuery(**values)
    assert RegionQuery.parse(query.format(), 8) == query


@many
@given(st.fixed_dictionaries({**looks, "points": st.lists(st.tuples(finite, finite), max_size=9).map(tuple)}))
def test_cells_queries_there_and_back(values: dict) -> None:
    query = CellsQuery(**values)
    assert CellsQuery.parse(*query.format()) == query


@many
@given(boxes, positive, st.sampled_from(["bbox", "older", "both"]))
def test_forget_queries_there_and_back(bbox: tuple[float, float, float, float], older: float, which: str) -> None:
    query = ForgetQuery(bbox=None if which == "older" else bbox, older=None if which == "bbox" else older)
    assert ForgetQuery.parse(query.format()) == query


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "bad_parameter"),
        ("older=0", "bad_parameter"),
        ("older=old", "bad_parameter"),
        ("bbox=0,0,0,1", "bad_bbox"),
        ("older=1;level=0", "unknown_parameter"),
    ],
)
def test_what_forget_refuses(text: str, code: str) -> None:
    """Above all nothing at all: that would be a reset."""
    with pytest.raises(QueryFault) as caught:
        ForgetQuery.parse(text)
    assert caught.value.code == code


def test_the_defaults() -> None:
    query = TileQuery.parse("")
    assert query == TileQuery(layers=("mean_height",), bbox=None, since=None, epoch=None, tolerance=None, limits=None)
    assert (query.dtype, query.compression, query.format()) == ("f4", None, "")
    assert RegionQuery.parse(BBOX, 1) == RegionQuery(bbox=(0.0, 0.0, 1.0, 1.0), level=0)


def test_every_parameter_as_a_foreign_client_writes_it() -> None:
    text = (
        "layers=range,mean_height;bbox=-1.5,+2,3e2,.5e3;since=7;epoch=2;tolerance=0.1;"
        "limits=slope:0.5,confidence:.9;dtype=f8;compression=zstd;_time=now;_anyke;_x=a b"
    )
    assert TileQuery.parse(text) == TileQuery(
        layers=("range", "mean_height"),
        bbox=(-1.5, 2.0, 300.0, 500.0),
        since=7,
        epoch=2,
        tolerance=0.1,
        limits={"slope": 0.5, "confidence": 0.9},
        dtype="f8",
        compression="zstd",
    )
    assert RegionQuery.parse(f"{BBOX};level=3", 8).level == 3
    assert CellsQuery.parse("x=-1;y=2.5").points == ((-1.0, 2.5),)
    assert CellsQuery.parse("layers=range", b"[[1, 2], [-3.5, 4e0]]").points == ((1.0, 2.0), (-3.5, 4.0))
    assert CellsQuery.parse("", b"[]").points == ()


def test_values_hold_all_after_the_first_equals_sign() -> None:
    assert parse_parameters("a=b=c;d==;e=") == {"a": "b=c", "d": "=", "e": ""}


CASES = [
    # (code, text, what the message names); for tiles
    ("unknown_parameter", "layer=range", "layer"),
    ("unknown_parameter", "level=1", "level"),
    ("unknown_parameter", "Layers=range", "Layers"),
    ("bad_parameter", "layers=range;layers=range", "twice"),
    ("bad_parameter", "dtype=f4;_a=1;dtype=f8", "twice"),
    ("bad_parameter", "layers", "layers: expected layers=VALUE; found no value"),
    ("bad_parameter", "=1", "name=value"),
    ("bad_parameter", ";", "name=value"),
    ("bad_parameter", "dtype=f4;", "name=value"),
    ("bad_parameter", "dtype= f4", "blanks"),
    ("bad_parameter", "dtype=f4; epoch=1", "blanks"),
    ("bad_parameter", "tolerance=0.1\t", "blanks"),
    ("bad_parameter", "layers=range,range", "once"),
    ("unknown_layer", "layers=", "''"),
    ("unknown_layer", "layers=height", "'height'"),
    ("unknown_layer", "layers=range,", "''"),
    ("unknown_layer", "layers=Range", "'Range'"),
    ("bad_parameter", "since=1", "epoch=N"),
    ("bad_parameter", "since=-1;epoch=1", "since"),
    ("bad_parameter", "since=1.0;epoch=1", "since"),
    ("bad_parameter", "since=01;epoch=1", "since"),
    ("bad_parameter", "since=1;epoch=+1", "epoch"),
    ("bad_parameter", "since=1;epoch=", "epoch"),
    ("bad_parameter", "since=" + "9" * 5000 + ";epoch=1", "since"),
    *(("bad_parameter", f"tolerance={t}", "tolerance") for t in ("0", "-0.1", "nan", "inf", "1e999", "0x1", "1_0", "")),
    *(("bad_parameter", f"limits={t}", "limits") for t in ("", "slope", "slope:0", "slope:-1", "slope:nan", "steep:1")),
    *(("bad_parameter", f"limits={t}", "limits") for t in ("slope:1,slope:1", "slope=1", "slope:1,", "slope:1:2")),
    *(("bad_parameter", f"dtype={t}", "f4 or f8") for t in ("f2", "F4", "")),
    *(("bad_parameter", f"compression={t}", "zstd") for t in ("none", "lz4", "")),
    ("too_large", "layers=" + "range," * 20_000, "parameters"),
]
BAD_BOXES = [
    "",
    "0,0,1",
    "0,0,1,1,1",
    "0,0,0,1",
    "0,0,1,0",
    "1,0,0,1",
    "0,0,nan,1",
    "0,0,inf,1",
    "0,0,1e999,1",
    "a,b,c,d",
]
BAD_BOXES += ["0,0,1,", "0,0,1,1x", "0, 0, 1, 1", "[0,0,1,1]", "0,0,1_0,1"]


@pytest.mark.parametrize(("code", "text", "named"), CASES, ids=lambda value: str(value)[:40])
def test_tile_queries_that_are_refused(code: str, text: str, named: str) -> None:
    with pytest.raises(QueryFault) as caught:
        TileQuery.parse(text)
    assert caught.value.code == code
    assert named in caught.value.message
    assert len(caught.value.message) < 500  # no echo of any length


@pytest.mark.parametrize("box", BAD_BOXES)
def test_any_fault_in_a_bbox(box: str) -> None:
    for parse in (TileQuery.parse, lambda text: RegionQuery.parse(text, 8)):
        with pytest.raises(QueryFault) as caught:
            parse(f"bbox={box}")
        assert caught.value.code == "bad_bbox"


@pytest.mark.parametrize(
    ("code", "text"),
    [
        ("bad_bbox", ""),
        ("bad_bbox", "level=1"),
        ("bad_level", f"{BBOX};level=8"),
        ("bad_level", f"{BBOX};level=-1"),
        ("bad_level", f"{BBOX};level=99999999999999"),
        *(("bad_parameter", f"{BBOX};level={text}") for text in ("", "one", "1.0", "+1", "01", "-0", "9" * 5000)),
        ("unknown_parameter", f"{BBOX};since=1"),
        ("unknown_parameter", f"{BBOX};x=1"),
    ],
    ids=lambda value: value[:40],
)
def test_region_queries_that_are_refused(code: str, text: str) -> None:
    with pytest.raises(QueryFault) as caught:
        RegionQuery.parse(text, 8)
    assert caught.value.code == code


MANY = json.dumps([[0, 0]] * 10_001).encode()


@pytest.mark.parametrize(
    ("code", "text", "payload"),
    [
        ("bad_parameter", "", b""),
        ("bad_parameter", "x=1", b""),
        ("bad_parameter", "y=1", b"[[1, 2]]"),
        ("bad_parameter", "x=1;y=2", b"[[1, 2]]"),
        ("bad_parameter", "x=one;y=2", b""),
        ("bad_parameter", "x=nan;y=2", b""),
        *(
            ("bad_parameter", "", p)
            for p in (b"{}", b"[1, 2]", b"[[1]]", b"[[1, 2, 3]]", b"[[1, null]]", b'[["1", 2]]')
        ),
        *(("bad_parameter", "", p) for p in (b"[[NaN, 1]]", b"[[1e999, 1]]", b"[[true, 1]]", b"[[1, 2]", b"\xff")),
        ("too_large", "", MANY),
        ("too_large", "", b"[" + b" " * (1 << 20) + b"]"),
        ("unknown_parameter", "x=1;y=2;dtype=f8", b""),
        ("unknown_layer", "x=1;y=2;layers=z", b""),
    ],
)
def test_cells_queries_that_are_refused(code: str, text: str, payload: bytes) -> None:
    with pytest.raises(QueryFault) as caught:
        CellsQuery.parse(text, payload)
    assert caught.value.code == code


def test_as_many_places_as_are_allowed() -> None:
    assert len(CellsQuery.parse("", json.dumps([[0, 0]] * 10_000).encode()).points) == 10_000
