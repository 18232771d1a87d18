"""`roughmap export`: sources, options, and what goes wrong."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner
from exported_map import LAYERS, Stored, store
from live_service import live_service
from net import WAIT_S, wait_until

from roughmap_client import RoughMapClient
from roughmap_service.cli.export import export
from roughmap_service.cli.main import run as command_line


def run(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(export, [str(argument) for argument in arguments])
    return done.exit_code, done.output


def test_what_was_written_is_told(stored: Stored, tmp_path: Path) -> None:
    code, said = run(stored.path, "-o", tmp_path / "a.npz", "--json")
    assert code == 0
    told = json.loads(said)
    assert told["layers"] == list(LAYERS)
    assert told["cells"] == list(stored.layers["slope"].shape[::-1])
    assert tuple(told["origin"]) == stored.low


def test_a_box_and_a_level_choose_the_cells(stored: Stored, tmp_path: Path) -> None:
    x, y = stored.low
    box = f"{x + 10},{y + 5},{x + 14},{y + 7}"
    assert run(stored.path, "-o", tmp_path / "a.npz", "--bbox", box)[0] == 0
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["max_height"], stored.layers["max_height"][20:28, 40:56], equal_nan=True)
        assert tuple(arrays["origin"]) == (x + 10, y + 5)
    assert run(stored.path, "-o", tmp_path / "b.npz", "--bbox", box, "--level", 1)[0] == 0
    with np.load(tmp_path / "b.npz") as arrays:
        assert arrays["max_height"].shape == (4, 8)
        assert arrays["cell_size"] == 0.5


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "a.doc"], "unknown format '.doc' (allowed: .tif, "),
        (["-o", "none/a.npz"], "there is no folder none"),
        (["-o", "a.npz", "--layers", "hight"], "unknown layer 'hight'"),
        (["-o", "a.asc", "--layers", "slope,count"], "holds one layer"),
        (["-o", "a.ply", "--layers", "slope"], "--layers mean_height,slope"),
        (["-o", "a.yaml", "--layers", "slope"], "leave out --layers"),
        (["-o", "a.npz", "--level", "20"], "the map has the levels 0 to 7"),
        (["-o", "a.npz", "--bbox", "0,0,1,1"], "nothing is known in --bbox; the map's tiles lie in 412"),
        (["-o", "a.tif", "--crs", "EPSG:999999"], "coordinate reference system 'EPSG:999999'"),
        (["-o", "a.npz", "--connect", "tcp/127.0.0.1:1"], "not both"),
        (["-o", "a.npz", "--crs", "UTM33"], "--crs UTM33: expected EPSG:CODE"),
        (["other.db", "-o", "a.npz"], "expected the logs (*.mcap) of one run, or one map.db alone"),
    ],
)
def test_a_wrong_use_is_one_line(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [argument.replace("other.db", str(stored.path)) for argument in arguments]
    assert command_line(["export", str(stored.path), *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("scan.las", "scan.las: neither a map.db nor a log; make a map of a recording first: roughmap build"),
        ("bag/metadata.yaml", "bag: a folder without roughmap's logs; make a map of a recording first"),
        ("scans/1.ply", "scans: a folder without roughmap's logs; make a map of a recording first"),
    ],
)
def test_a_recording_is_not_yet_a_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, name: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"LASF and so on, of some length")
    assert command_line(["export", name.split("/", maxsplit=1)[0], "-o", "a.npz"]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_a_store_of_an_earlier_release_says_what_to_export_instead(tmp_path: Path, capsys) -> None:
    old = tmp_path / "map.db"
    old.write_bytes((Path(__file__).parents[1] / "offline" / "state_1" / "map.db").read_bytes())
    assert command_line(["export", str(old), "-o", str(tmp_path / "a.npz")]) == 2
    said = capsys.readouterr().err
    assert "state version 1, not 2; export the logs of its run" in said
    assert said.count("\n") == 1


def test_what_stands_beside_is_only_replaced_by_force(stored: Stored, tmp_path: Path) -> None:
    for name, beside in (("a.png", "a.pgw"), ("a.yaml", "a.pgm"), ("a.tif", "a.qml")):
        (tmp_path / beside).write_text("mine")
        code, said = run(stored.path, "-o", tmp_path / name)
        assert code == 2
        assert f"{beside} exists" in said
        assert (tmp_path / beside).read_text() == "mine"


@pytest.mark.parametrize("name", ["a.npz", "a.tif", "a.png", "a.las", "bag"])
def test_an_export_that_fails_leaves_what_was_there(
    stored: Stored, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The map's tiles can't be read from the second one on, as from a bad disk."""
    assert run(stored.path, "-o", tmp_path / name)[0] == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    broken = tmp_path / "broken.db"
    content = bytearray(stored.path.read_bytes())
    content[len(content) // 3 : len(content) // 3 + 8192] = bytes(8192)
    broken.write_bytes(content)
    assert command_line(["export", str(broken), "-o", str(tmp_path / name), "--force"]) != 0
    broken.unlink()
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not list(tmp_path.glob(".roughmap-*"))


def test_a_file_is_only_replaced_by_force(stored: Stored, tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_text("mine")
    code, said = run(stored.path, "-o", tmp_path / "a.npz")
    assert code == 2
    assert "--force" in said
    assert (tmp_path / "a.npz").read_text() == "mine"
    assert run(stored.path, "-o", tmp_path / "a.npz", "--force")[0] == 0


def test_an_export_leaves_the_store_as_it_was(tmp_path: Path) -> None:
    stored = store(tmp_path)
    before = stored.path.read_bytes()
    assert run(stored.path, "-o", tmp_path / "a.npz")[0] == 0
    assert stored.path.read_bytes() == before


def test_a_running_service_and_its_log_give_the_same_file(tmp_path: Path) -> None:
    """The rover's scans, exported from the service, from its log and from its store."""
    settings = (
        "[sensors.lidar]\ntranslation = [0.25, 0.0, 1.05]\nrange_sigma = 0.02\nbeam_sigma = 0.0005\nmin_range = 0.5\n"
        f'[store]\npath = "{tmp_path / "map.db"}"\n'
    )
    with live_service(tmp_path, settings) as service:
        connect = ["--connect", service.endpoints[0]]
        assert command_line(["simulate", *connect, "--duration", "0.5", "--rate", "0", "--columns", "128"]) == 0
        with RoughMapClient("site", connect=service.endpoints, timeout=WAIT_S) as client:

            def all_decided() -> bool:
                clouds = client.status().clouds
                return clouds.accepted + sum(clouds.rejected.values()) == 5 and clouds.waiting == 0

            wait_until(all_decided, "all scans are decided")
        assert command_line(["export", *connect, "-o", str(tmp_path / "served.npz")]) == 0
    logs = [str(tmp_path / "log")]
    assert command_line(["export", *logs, "-o", str(tmp_path / "logged.npz")]) == 0
    assert command_line(["export", str(tmp_path / "map.db"), "-o", str(tmp_path / "stored.npz")]) == 0
    with np.load(tmp_path / "served.npz") as served:
        for other in ("logged.npz", "stored.npz"):
            with np.load(tmp_path / other) as arrays:
                assert arrays.files == served.files
                for name in arrays.files:
                    assert np.array_equal(arrays[name], served[name], equal_nan=arrays[name].dtype.kind == "f"), name


def test_the_reference_system_of_the_recordings_comes_out_again(tmp_path: Path) -> None:
    stored = store(tmp_path, crs="EPSG:25833")
    with_own = tmp_path / "own.tif"
    assert run(stored.path, "-o", with_own)[0] == 0
    with tifffile.TiffFile(with_own) as tiff:
        assert tiff.pages[0].geotiff_tags["ProjectedCSTypeGeoKey"] == 25833
    assert run(stored.path, "-o", tmp_path / "other.tif", "--crs", "EPSG:32633")[0] == 0
    with tifffile.TiffFile(tmp_path / "other.tif") as tiff:
        assert tiff.pages[0].geotiff_tags["ProjectedCSTypeGeoKey"] == 32633
