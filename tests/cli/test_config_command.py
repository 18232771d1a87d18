"""`roughmap config`: secrets stay hidden, faults name source, key and what is allowed, a group alone shows its help."""

import json
from pathlib import Path

import pytest

from roughmap_schemas import load_config
from roughmap_service.cli.main import run
from roughmap_service.simulation.rover import sensor_settings
from roughmap_service.simulation.scanner import Scanner


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def called(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = run(arguments)
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_secrets_are_hidden(form: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("roughmap.toml").write_text(
        '[zenoh]\nconnect = ["tls/router:7447#secret=TOPSECRET", "tcp/h:1?user=a;password=TOPSECRET"]\n'
    )
    code, out, err = called(["config", "show", *form], capsys)
    assert code == 0
    assert "TOPSECRET" not in out + err
    assert "tls/router:7447#hidden" in out
    assert "tcp/h:1#hidden" in out


def test_json_has_every_setting_that_the_text_has(capsys: pytest.CaptureFixture[str]) -> None:
    text = called(["config", "show"], capsys)[1]
    rows = json.loads(called(["config", "show", "--json"], capsys)[1])
    assert [line.split(" = ")[0] for line in text.splitlines()] == list(rows)
    assert {row["source"] for row in rows.values()} == {"default"}


@pytest.mark.parametrize(
    ("file", "variable", "option", "said"),
    [
        ("[map]\ncel_size = 0.2\n", None, None, ["roughmap.toml", "map.cel_size", "unknown key", "cell_size"]),
        ("", ("ROUGHMAP_MAP__CEL_SIZE", "1"), None, ["ROUGHMAP_MAP__CEL_SIZE", "unknown key", "cell_size"]),
        ("", None, "map.cel_size=1", ["command line", "map.cel_size", "unknown key", "cell_size"]),
        ("[map]\nlevels = 99\n", None, None, ["roughmap.toml", "map.levels", "99"]),
        ("[log]\ncompression = 'gzip'\n", None, None, ["roughmap.toml", "log.compression", "lz4", "zstd", "gzip"]),
        ("[sensors.lidar]\nbeam_sigma = 0.1\n", None, None, ["sensors.lidar.range_sigma", "is required"]),
        ("[map\n", None, None, ["roughmap.toml", "invalid TOML", "line 1"]),
        ("", None, 'zenoh.listen=["7447"]', ["command line", "zenoh.listen", "must match", "7447"]),
    ],
)
def test_a_fault_names_its_source_its_key_and_what_is_allowed(
    file: str,
    variable: tuple[str, str] | None,
    option: str | None,
    said: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("roughmap.toml").write_text(file)
    if variable is not None:
        monkeypatch.setenv(*variable)
    code, out, err = called(["config", "check", *(["--set", option] if option else [])], capsys)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert all(part in err for part in said), err


@pytest.mark.parametrize("arguments", [[], ["config"]])
def test_a_group_alone_shows_its_help(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = called(arguments, capsys)
    assert (code, out) == (2, "")
    assert err.startswith("Usage: roughmap")
    assert err == called([*arguments, "--help"], capsys)[1]


def test_the_example_is_valid_and_has_the_sensor_of_simulate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["config", "example"]) == 0
    file = tmp_path / "roughmap.toml"
    file.write_text(capsys.readouterr().out)
    lidar = load_config(file).config.sensors["lidar"]
    simulated = sensor_settings(Scanner())
    assert list(lidar.translation) == simulated["translation"]
    assert (lidar.range_sigma, lidar.beam_sigma, lidar.min_range) == tuple(
        simulated[name] for name in ("range_sigma", "beam_sigma", "min_range")
    )
