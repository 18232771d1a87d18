"""Regions and single cells, asked over real sessions by the contract alone."""

import json
from collections.abc import Iterator

import numpy as np
import pytest
import zenoh
import zstandard
from asking_raw import RawTile, get
from served import INSTANCE, T0, Served

from roughmap.cell import CELL_DTYPE

BOX = (-3.05, -2.0, 4.0, 5.25)


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with Served({"query": {"max_region_cells": 500_000}}) as served:
        yield served


@pytest.mark.parametrize("level", [0, 2])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_a_region_is_the_maps_own(served: Served, level: int, dtype: str) -> None:
    names = ["mean_height", "std_dev", "slope", "traversability", "count"]
    text = f"bbox={','.join(map(str, BOX))};level={level};layers={','.join(names)};dtype={dtype}"
    (sample,) = get(served.asker, f"maps/site/region?{text}").ok
    reply = RawTile(sample)
    own = served.map.region(BOX, names, level=level, limits=served.config.map.limits)
    found = reply.layers()
    assert list(found) == names
    for name in names:
        expected = own[name].astype(dtype)
        assert found[name].shape == own.shape
        assert np.array_equal(found[name], expected, equal_nan=True), name
    grid, info = reply.grid, reply.info
    assert (grid.pose.position.x, grid.pose.position.y) == own.origin
    assert grid.cell_size.x == grid.cell_size.y == own.cell_size == 0.1 * 2**level
    assert (info["x"], info["y"], info["digest"], info["z"], info["answer_tiles"]) == (None, None, None, level, 1)
    assert (info["map_sequence"], info["epoch"], info["instance"]) == (served.map.sequence, 5, INSTANCE)
    assert info["known_cells"] == np.count_nonzero(own["count"])
    assert T0 <= info["oldest_ns"] <= info["newest_ns"] == reply.stamp_ns


def test_a_compressed_region(served: Served) -> None:
    (plain,) = get(served.asker, "maps/site/region?bbox=0,0,3,2").ok
    (packed,) = get(served.asker, "maps/site/region?bbox=0,0,3,2;compression=zstd").ok
    packed_reply = RawTile(packed)
    assert packed_reply.info["compression"] == "zstd"
    data = zstandard.ZstdDecompressor().decompress(packed_reply.grid.data)
    assert data == RawTile(plain).grid.data


def test_unknown_ground_is_nan_and_no_error(served: Served) -> None:
    (sample,) = get(served.asker, "maps/site/region?bbox=500,500,501,502;layers=mean_height,count").ok
    layers = RawTile(sample).layers()
    assert np.isnan(layers["mean_height"]).all()
    assert layers["mean_height"].shape == (20, 10)
    assert not layers["count"].any()
    assert RawTile(sample).info["known_cells"] == 0


@pytest.mark.parametrize(
    ("parameters", "code"),
    [
        ("", "bad_bbox"),
        ("bbox=0,0,1", "bad_bbox"),
        ("bbox=1,0,0,1", "bad_bbox"),
        ("bbox=0,0,nan,1", "bad_bbox"),
        ("bbox=1e12,0,1.0000000001e12,1", "bad_bbox"),
        ("bbox=0,0,71,71", "too_large"),
        ("bbox=0,0,1e9,1e9", "too_large"),
        ("bbox=0,0,2.5e-7,1e11", "too_large"),
        ("bbox=0,0,1e300,1e300", "too_large"),
        ("bbox=0,0,1,1;level=8", "bad_level"),
        ("bbox=0,0,1,1;level=-1", "bad_level"),
        ("bbox=0,0,1,1;layers=height", "unknown_layer"),
        ("bbox=0,0,1,1;since=3;epoch=5", "unknown_parameter"),
        ("bbox=0,0,1,1;dtype=f2", "bad_parameter"),
        ("bbox=0,0,1,1;tolerance=0", "bad_parameter"),
        ("bbox=0,0,1,1;limits=slope:0", "bad_parameter"),
    ],
)
def test_what_is_no_region(served: Served, parameters: str, code: str) -> None:
    assert get(served.asker, f"maps/site/region?{parameters}").error() == code


def test_cells_say_what_the_map_keeps(served: Served) -> None:
    """In the asked order, some twice, known and unknown ones mixed; records to the bit."""
    rng = np.random.default_rng(3)
    places = [*rng.uniform(-9, 9, (400, 2)).tolist(), [0.05, 0.05], [0.05, 0.05], [1e6, -1e6]]
    asked = "maps/site/cells?layers=mean_height,confidence_factor"
    answer = get(served.asker, asked, json.dumps(places).encode()).json()
    assert set(answer) == {"contract", "map", "instance", "epoch", "sequence", "cells"}
    assert (answer["map"], answer["sequence"]) == ("site", served.map.sequence)
    assert [(cell["x"], cell["y"]) for cell in answer["cells"]] == [tuple(place) for place in places]
    known = 0
    with served.map.freeze() as frozen:
        for cell in answer["cells"]:
            i, j = int(np.floor(cell["x"] / 0.1)), int(np.floor(cell["y"] / 0.1))
            assert (cell["i"], cell["j"]) == (i, j)
            record = frozen.records(i >> 6, j >> 6)[j & 63, i & 63]
            if record["count"] == 0:
                assert cell["state"] is None
                assert cell["layers"] == {"mean_height": None, "confidence_factor": None}
                continue
            known += 1
            assert tuple(cell["state"][name] for name in CELL_DTYPE.names) == record.item()
            assert cell["layers"]["mean_height"] == record["mean"]
            assert cell["layers"]["confidence_factor"] == 1.0 / record["inv_cf"]
    assert 20 < known < len(places)


def test_one_cell_by_parameters(served: Served) -> None:
    answer = get(served.asker, "maps/site/cells?x=-0.05;y=0.3").json()
    (cell,) = answer["cells"]
    assert (cell["i"], cell["j"]) == (-1, int(np.floor(0.3 / 0.1)))
    assert list(cell["layers"]) == ["mean_height"]


def test_no_place_at_all(served: Served) -> None:
    assert get(served.asker, "maps/site/cells", b"[]").json()["cells"] == []


@pytest.mark.parametrize(
    ("parameters", "payload", "code"),
    [
        ("", None, "bad_parameter"),
        ("x=1", None, "bad_parameter"),
        ("x=1;y=2", b"[[1, 2]]", "bad_parameter"),
        ("", b"[[1, 2], [3]]", "bad_parameter"),
        ("", b"[[1, NaN]]", "bad_parameter"),
        ("", b"not json", "bad_parameter"),
        ("x=1e308;y=0", None, "bad_parameter"),
        ("x=3e8;y=0", None, "bad_parameter"),
        ("x=1;y=2;bbox=0,0,1,1", None, "unknown_parameter"),
        ("x=1;y=2;layers=height", None, "unknown_layer"),
        ("", json.dumps([[0, 0]] * 10_001).encode(), "too_large"),
        ("", b" " * (1 << 20) + b"[]", "too_large"),
    ],
)
def test_what_is_no_place(served: Served, parameters: str, payload: bytes | None, code: str) -> None:
    selector = f"maps/site/cells?{parameters}" if parameters else "maps/site/cells"
    assert get(served.asker, selector, payload).error() == code


def test_ten_thousand_places_are_the_limit(served: Served) -> None:
    answer = get(served.asker, "maps/site/cells", json.dumps([[0.0, 0.0]] * 10_000).encode()).json()
    assert len(answer["cells"]) == 10_000


def test_every_answer_is_logged_with_its_outcome(served: Served) -> None:
    get(served.asker, "maps/site/region?bbox=0,0,1,1.5")
    get(served.asker, "maps/site/cells?x=1.5")
    expected = {("maps/site/region?bbox=0,0,1,1.5", 1, "ok"), ("maps/site/cells?x=1.5", 0, "bad_parameter")}

    def told() -> set[tuple[str, int, str]]:
        return {(record.selector, record.tiles, record.outcome) for record in served.records}

    with served.recorded:
        assert served.recorded.wait_for(lambda: expected <= told(), 30)


def test_status_has_every_member(served: Served) -> None:
    found = get(served.asker, "maps/site/status")
    status = found.json()
    assert str(found.ok[0].encoding) == "application/json;roughmap.MapStatus"
    assert set(status) == {
        "contract", "map", "run", "instance", "epoch", "version", "frame_id", "cell_size", "tile_cells", "levels",
        "layers",
        "bounds", "extent", "error_model", "surface", "configuration_digest", "health", "problems", "sequence",
        "durable_sequence", "input",
        "newest_stamp_ns", "clouds", "points", "poses", "refused", "gaps", "jumps", "recent", "lag_s", "rates",
        "memory_bytes", "tiles", "forgotten", "log", "uptime_s",
    }  # fmt: skip
    assert (status["epoch"], status["sequence"], status["tile_cells"]) == (5, served.map.sequence, 64)
    assert status["extent"] == list(served.map.extent() or ())
    assert get(served.asker, "maps/site/status?a=1").error() == "unknown_parameter"


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ("forget", "bad_parameter"),
        ("forget?older=0", "bad_parameter"),
        ("forget?bbox=1,1,0,0", "bad_bbox"),
        ("forget?now=1", "unknown_parameter"),
        ("forget?older=5;older=6", "bad_parameter"),
    ],
)
def test_what_is_not_forgotten(served: Served, asked: str, code: str) -> None:
    before = served.map.sequence
    assert get(served.asker, f"maps/site/control/{asked}").error() == code
    assert served.map.sequence == before


def test_forgetting_a_box() -> None:
    with Served() as served:
        answer = get(served.asker, "maps/site/control/forget?bbox=-12.8,-6.4,-0.1,6.4").json()
        assert answer == {"contract": "1.0", "sequence": 6, "epoch": 5, "tiles": 4}
        assert get(served.asker, "maps/site/control/forget?bbox=-12.8,-6.4,-0.1,6.4").json()["tiles"] == 0
        assert served.map.sequence == 6


def test_control_is_asked_by_its_own_key_alone(served: Served) -> None:
    for parameters in ("", "?older=5"):
        found = get(served.asker, f"maps/site/control/*{parameters}")
        assert ([error["code"] for error in found.errors], found.ok) == (["bad_key", "bad_key"], [])
    assert get(served.asker, "maps/site/control/reset?now=1").error() == "unknown_parameter"
    assert served.view.epoch == 5
    assert get(served.asker, "maps/site/control/nothing") == get(served.asker, "maps/other/control/reset")
    before = served.map.sequence
    answer = get(served.asker, "maps/site/control/reset").json()
    assert answer == {"contract": "1.0", "sequence": before + 1, "epoch": 6, "tiles": 0}
    (sample,) = get(served.asker, "maps/site/region?bbox=0,0,1,1").ok
    assert isinstance(sample, zenoh.Sample)
    assert RawTile(sample).info["epoch"] == 6
    assert RawTile(sample).info["known_cells"] == 0
