"""The command line's frame: help that can be run, one-line errors, exit codes, the configuration's commands."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

from roughmap_service.cli.main import COMMANDS, cli, run

ALL = [[name] for name in COMMANDS] + [["config", name] for name in ("example", "show", "check", "schema")]


def called(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str, str]:
    code = run(arguments)
    out, err = capsys.readouterr()
    return code, out, err


def found(path: list[str]) -> click.Command:
    command: click.Command = cli
    for name in path:
        assert isinstance(command, click.Group)
        inner = command.get_command(click.Context(command), name)
        assert inner is not None
        command = inner
    return command


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No ./roughmap.toml and no ROUGHMAP_ variables but those of the test."""
    monkeypatch.chdir(tmp_path)
    for name in [name for name in __import__("os").environ if name.startswith("ROUGHMAP_")]:
        monkeypatch.delenv(name)


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_help_opens_with_a_line_that_can_be_run(path: list[str], tmp_path: Path) -> None:
    command = found(path)
    line = (command.help or "").splitlines()[0]
    words = shlex.split(line.rpartition("&& ")[2].partition(" >")[0])
    assert words[: 1 + len(path)] == ["roughmap", *path]
    # Its options and values must be valid; `.ci/help_lines` runs it.
    for word in words[1 + len(path) :]:
        if word.endswith((".xyz", ".db")):
            (tmp_path / word).touch()
        if word.endswith("/"):
            (tmp_path / word).mkdir()
    if not isinstance(command, click.Group):
        assert command.make_context(path[-1], words[1 + len(path) :])


def test_help_names_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = called(["--help"], capsys)
    assert code == 0
    assert all(name in out for name in COMMANDS)


def test_help_needs_no_heavy_library() -> None:
    script = (
        "import sys; from roughmap_service.cli.main import run; run(['--help'])\n"
        "heavy = {'numba', 'zenoh', 'matplotlib', 'scipy', 'numpy'} & set(sys.modules)\n"
        "sys.exit(f'loaded {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = called(["--version"], capsys)
    assert code == 0
    assert out.startswith("roughmap ")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["fly"], "fly"),
        (["query"], "--bbox"),
        (["query", "--bbox", "1,2,3"], "four numbers"),
        (["query", "--bbox", "1,2,1,5"], "xmin < xmax"),
        (["query", "--bbox", "1,2,nan,5"], "xmin < xmax"),
        (["query", "--bbox", "0,0,1,1", "--layers", "mean_height,colour"], "unknown layer 'colour' (allowed:"),
        (["simulate", "--robots", "0"], "--robots"),
        (["simulate", "--from", "absent.npz"], "absent.npz"),
        (["simulate", "--connect", "7447"], "PROTOCOL/ADDRESS"),
        (["query", "--bbox", "0,0,1,1", "--connect", "localhost:7447"], "PROTOCOL/ADDRESS"),
        (["build", "absent.npz", "-o", "map.db"], "absent.npz"),
        (["build"], "RECORDINGS"),
        (["config", "check", "--set", "map.cell_size"], "KEY=VALUE"),
        (["config", "check", "--set", "map.cell_size=-1"], "map.cell_size"),
        (["config", "check", "--set", "map.colour=red"], "map.colour"),
        (["config", "check", "-c", "absent.toml"], "absent.toml"),
        (["demo", "--seconds", "0"], "--seconds"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_use_is_one_line_and_exit_2(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    code, out, err = called(arguments, capsys)
    assert code == 2
    assert out == ""
    assert said in err
    assert err.startswith("roughmap: ")
    assert err.count("\n") == 1


def test_nobody_there_is_one_line_and_exit_1(capsys: pytest.CaptureFixture[str]) -> None:
    # Port 1 on loopback: nobody listens there.
    code, _, err = called(["query", "--bbox", "0,0,1,1", "--connect", "tcp/127.0.0.1:1", "--timeout", "0.5"], capsys)
    assert code == 1
    assert err.startswith("roughmap: no connection to tcp/127.0.0.1:1 ")
    assert "is `roughmap serve` up there" in err
    assert ".rs" not in err  # no place in the transport's own sources
    assert err.count("\n") == 1


def test_a_rover_that_nobody_hears(capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = called(
        ["simulate", "--connect", "tcp/127.0.0.1:1", "--wait", "0.2", "--rings", "4", "--columns", "8"], capsys
    )
    assert code == 1
    assert "nobody answers on tcp/127.0.0.1:1 " in err
    assert "is `roughmap serve` up there?" in err
    assert err.count("\n") == 1


def test_ctrl_c_is_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("roughmap_service.cli.config.load", interrupted)
    code, out, err = called(["config", "show"], capsys)
    assert (code, out, err.strip()) == (130, "", "roughmap: interrupted")


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("roughmap_service.cli.config.load", broken)
    with pytest.raises(ZeroDivisionError):
        run(["config", "show"])


def test_a_reader_that_leaves_is_no_error() -> None:
    # `| head -1`: the reader closes its end while we still print.
    program = [sys.executable, "-m", "roughmap_service.cli.main", "config", "schema"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        err = process.stderr.read()
        process.wait(60)
    assert err == b""


def test_show_names_the_source_of_each_setting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "roughmap.toml").write_text('[map]\nname = "quarry"\ncell_size = 0.5\ncoverage = 3.0\n')
    monkeypatch.setenv("ROUGHMAP_MAP__CELL_SIZE", "0.25")
    monkeypatch.setenv("ROUGHMAP_MAP__COVERAGE", "2.5")
    code, out, _ = called(["config", "show", "--json", "--set", "map.coverage=1.5"], capsys)
    assert code == 0
    rows = json.loads(out)
    assert rows["map.name"]["value"] == "quarry"
    assert "roughmap.toml" in rows["map.name"]["source"]
    assert rows["map.cell_size"]["value"] == 0.25
    assert "environment" in rows["map.cell_size"]["source"]
    assert rows["map.coverage"]["value"] == 1.5
    assert "command line" in rows["map.coverage"]["source"]
    assert rows["map.levels"] == {"value": 8, "source": "default"}


def test_show_as_text_has_a_line_a_setting(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = called(["config", "show"], capsys)
    assert code == 0
    (line,) = [line for line in out.splitlines() if line.startswith("map.cell_size ")]
    assert line.split("#")[0].strip() == "map.cell_size = 0.1"
    assert line.endswith("# default")


def test_check_gives_the_digest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "here.toml"
    file.write_text("[sensors.lidar]\nrange_sigma = 0.02\n")
    code, out, _ = called(["config", "check", "-c", str(file), "--json"], capsys)
    assert code == 0
    answer = json.loads(out)
    assert answer["ok"]
    assert answer["path"] == str(file)
    assert len(answer["configuration_digest"]) == 32


def test_the_schema_is_json_and_knows_the_sections(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = called(["config", "schema"], capsys)
    assert code == 0
    assert {"map", "zenoh", "input", "sensors", "log"} <= set(json.loads(out)["properties"])
