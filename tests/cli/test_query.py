"""`roughmap query` of a service that `roughmap simulate --from` fed: table, JSON, NPZ, PNG, and each refusal."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from live_service import decisions, live_service
from matplotlib.image import imread
from recordings import LIDAR, plane, write_recording

from roughmap_service.cli.main import run

BOX = ["--bbox", "-2,-1,2,1"]


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a service answers that has taken up the recording."""
    folder = tmp_path_factory.mktemp("query")
    recording = write_recording(folder / "scans.npz")
    with live_service(folder, LIDAR) as service:
        with decisions(service) as heard:
            assert run(["simulate", "--from", str(recording), "--connect", service.endpoints[0], "--rate", "0"]) == 0
            decided = heard.wait(lambda events: len(events) == 3, "the decisions on three clouds")
        assert [(event.outcome, event.accepted) for event in decided] == [("integrated", 8000)] * 3
        yield service.endpoints[0]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def query(endpoint: str, *arguments: str) -> int:
    return run(["query", "--connect", endpoint, *BOX, *arguments])


def test_the_table_has_a_line_a_layer(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert query(endpoint, "--layers", "mean_height,slope,count") == 0
    first, heading, *rows = capsys.readouterr().out.splitlines()
    assert first.startswith("site: 40 x 20 cells of 0.1 m from (-2, -1), sequence 3, answered in ")
    assert heading.split() == ["layer", "known", "min", "median", "mean", "max"]
    assert [row.split()[0] for row in rows] == ["mean_height", "slope", "count"]
    assert [row.split()[1] for row in rows] == ["800"] * 3


def test_json_says_what_was_measured(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert query(endpoint, "--layers", "mean_height", "--level", "1", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["map"], report["sequence"], report["level"], report["cell_size"]) == ("site", 3, 1, 0.2)
    assert (report["origin"], report["shape"]) == ([-2, -1], [10, 20])
    stats = report["layers"]["mean_height"]
    assert stats["known"] == 200
    assert stats["min"] <= stats["median"] <= stats["max"]
    # The plane at x = 0, in the middle of the box. A cell's points stray by 0.1 m (pose) on a slope of 0.1: a cell's
    # mean by 1 cm at the worst, the median of 200 of them by far less.
    assert stats["median"] == pytest.approx(plane(np.zeros(1))[0], abs=0.005)


def test_the_archive_holds_the_ground(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert query(endpoint, "--layers", "mean_height,count", "--npz", "ground.npz") == 0
    capsys.readouterr()
    ground = np.load("ground.npz")
    assert sorted(ground.files) == ["cell_size", "count", "epoch", "mean_height", "origin", "sequence"]
    height, (x, y), a = ground["mean_height"], ground["origin"], float(ground["cell_size"])
    assert (height.shape, x, y, a, int(ground["sequence"])) == ((20, 40), -2, -1, 0.1, 3)
    # Columns run along x, as the plane rises. Its points are whole millimetres, spread by 2 sigma of 5 cm on a slope
    # of 0.1, about 300 of them a cell: 1 cm is more than any cell's mean strays.
    expected = plane(x + (np.arange(40) + 0.5) * a)
    assert np.abs(height - expected[None, :]).max() < 0.01
    assert ground["count"].min() > 0


def test_the_picture_shows_all_layers_side_by_side(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert query(endpoint, "--png", "one.png", "--layers", "mean_height") == 0
    assert query(endpoint, "--png", "three.png", "--layers", "mean_height,confidence_level,count") == 0
    capsys.readouterr()
    one, three = imread("one.png"), imread("three.png")
    assert three.shape[1] == 3 * one.shape[1]
    assert np.unique(one.reshape(-1, one.shape[2]), axis=0).shape[0] > 50  # a shaded plane, not an empty frame


def test_ground_that_nobody_saw_is_drawn_and_said(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = run(["query", "--connect", endpoint, "--bbox", "500,500,501,501", "--png", "far.png", "--json"])
    assert code == 0
    layers = json.loads(capsys.readouterr().out)["layers"]
    assert {stats["known"] for stats in layers.values()} == {0}
    assert {stats["mean"] for stats in layers.values()} == {None}
    assert Path("far.png").is_file()


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--layers", "mean_height,colour"], 2, "unknown layer 'colour'"),
        (["--level", "20"], 2, "bad_level"),
        (["--map", "elsewhere", "--timeout", "0.5"], 1, "with the map 'elsewhere'?"),
        (["--map", "no/name"], 2, "no/name"),
        (["--npz", "absent/ground.npz"], 1, "absent/ground.npz: No such file or directory"),
        (["--png", "absent/ground.png"], 1, "absent/ground.png: No such file or directory"),
        (["--bbox", "-9999,-9999,9999,9999"], 2, "too_large"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_can_t_be_had_is_one_line(
    endpoint: str, arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert query(endpoint, *arguments) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.startswith("roughmap: ")
    assert err.count("\n") == 1


def test_the_configuration_says_where_to_ask_and_for_what(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("roughmap.toml").write_text(f'[zenoh]\nlisten = ["{endpoint}"]\n')
    assert run(["query", *BOX, "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["layers"]) == {"mean_height", "range", "confidence_factor"}
