"""The README's code runs as printed against a service; commands, make targets and links in all documents exist."""

import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
import zenoh
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from live_service import decisions, live_service
from net import WAIT_S, peer_config

from roughmap_schemas.config_load import config_from
from roughmap_service.cli.demo.processes import ServiceProcess
from roughmap_service.cli.main import cli, run

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = (
    "README.md", "CONTRIBUTING.md", "CHANGELOG.md", "ARCHITECTURE.md", "OPERATIONS.md", "RELIABILITY.md", "SECURITY.md",
    "schemas/README.md", "tests/bench/README.md", "service/roughmap_service/formats/README.md",
    "service/roughmap_ros/node/README.md",
)  # fmt: skip
PRINTED_ENDPOINT = "tcp/127.0.0.1:7447"


def blocks(language: str) -> list[str]:
    """The README's code blocks of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def shell_lines(page: str) -> list[str]:
    """What a page shows to type: code in backticks, lines of ``sh`` blocks and indented lines."""
    text = (ROOT / page).read_text(encoding="utf-8")
    fenced = re.findall(r"^ *```sh\n(.*?)^ *```$", text, re.MULTILINE | re.DOTALL)
    indented = re.findall(r"^ {4,}(.*)$", text, re.MULTILINE)
    inline = re.findall(r"`([^`]*)`", re.sub(r"^ *```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL))
    lines = [*indented, *inline, *(line for block in fenced for line in block.splitlines())]
    return [" ".join(line.partition(" #")[0].split()) for line in lines]


def commands(page: str) -> list[str]:
    """All `roughmap COMMAND ...` that a page shows to type."""
    start = re.compile(r"(?:docker compose exec map )?(?:[./]*\.venv/bin/)?(roughmap [a-z-].*)")
    return sorted({found[1] for line in shell_lines(page) if (found := start.fullmatch(line))})


@pytest.mark.parametrize("settings", blocks("toml"))
def test_settings_are_valid(settings: str) -> None:
    config_from(tomllib.loads(settings), "README.md")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ServiceProcess]:
    """A service with the README's configuration."""
    (settings,) = (block for block in blocks("toml") if "[sensors.lidar]" in block)
    with live_service(tmp_path_factory.mktemp("readme"), settings) as running:
        yield running


@pytest.fixture(scope="module")
def variables(service: ServiceProcess) -> dict[str, Any]:
    """What the README's Python leaves behind: fed as printed, then asked as printed once the cloud is decided."""
    feed, ask = (block.replace(PRINTED_ENDPOINT, service.endpoints[0]) for block in blocks("python"))
    left: dict[str, Any] = {}
    with decisions(service) as heard:
        exec(compile(feed, "README.md, feed", "exec"), left)
        (event,) = heard.wait(lambda events: len(events) == 1, "the decision on the README's cloud")
    assert event.outcome == "integrated"
    assert event.accepted + sum(event.rejected.values()) == len(left["points"])
    exec(compile(ask, "README.md, ask", "exec"), left)
    return left


def test_the_default_endpoint_stands_where_the_test_puts_its_own() -> None:
    assert [PRINTED_ENDPOINT in block for block in blocks("python")] == [True, True]


def test_what_is_fed_as_printed_is_answered_as_printed(variables: dict[str, Any]) -> None:
    ground = variables["ground"]
    height = ground["mean_height"]
    said = re.search(r"print\(ground\[\"mean_height\"\]\.shape.*# \((\d+), (\d+)\)", README)
    assert said is not None
    assert height.shape == (int(said[1]), int(said[2]))
    assert ground.sequence == 1
    x = ground.origin[0] + (np.arange(height.shape[1]) + 0.5) * ground.cell_size
    known = np.isfinite(height)
    assert known.mean() > 0.9  # min_range cuts no hole: the ground is 1.05 m below the scanner
    # The scanner stands 0.25 m ahead of a base that is at x = 0 to 0.1 m meanwhile, 1.05 m up. A point is spread over
    # 2 sigma of the pose, 0.1 m and more, of a slope of 0.2 at most, unevenly where the grid of points has its gaps:
    # 3 cm bounds that.
    truth = np.broadcast_to(0.2 * np.sin(x - 0.25 - 0.05), height.shape)
    assert np.abs(height - truth)[known].max() < 0.03
    assert variables["free"].any()


def test_the_printed_query_draws_a_picture(
    service: ServiceProcess, variables: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert variables["ground"].sequence == 1
    monkeypatch.chdir(tmp_path)
    (line,) = [command for command in commands("README.md") if command.startswith("roughmap query")]
    assert run([*shlex.split(line)[1:], "--connect", service.endpoints[0]]) == 0
    assert (tmp_path / "ground.png").read_bytes().startswith(b"\x89PNG")


def test_the_printed_selector_gets_grids(service: ServiceProcess, variables: dict[str, Any]) -> None:
    (selector,) = re.findall(r"`(maps/site/tiles/[^`]*)`", README)
    with zenoh.open(peer_config(connect=service.endpoints)) as session:
        replies = list(session.get(selector, timeout=WAIT_S, consolidation=zenoh.ConsolidationMode.NONE))
    # 4 x 4 m around the origin, in tiles of 6.4 m that meet there.
    assert len(replies) == 4
    for reply in replies:
        assert reply.ok is not None
        grid = Grid()
        grid.ParseFromString(reply.ok.payload.to_bytes())
        assert [field.name for field in grid.fields] == ["mean_height"]
        assert grid.cell_size.x == variables["ground"].cell_size


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_named_are_commands(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for line in commands(page):
        words = [word for word in shlex.split(line)[1:] if word != "..."]
        if words[0].startswith("-"):
            assert words[0] in {option for parameter in cli.params for option in parameter.opts} | {"--help"}, line
            continue
        command = cli.get_command(click.Context(cli), words[0])
        assert command is not None, line
        options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
        assert {word for word in words[1:] if word.startswith("--")} <= options, line


@pytest.mark.parametrize("page", PAGES)
def test_make_targets_named_are_targets(page: str) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {name for line in shell_lines(page) for name in re.findall(r"(?:^|&& )make ([a-z-]+)", line)}
    assert named <= targets


@pytest.mark.parametrize("page", PAGES)
def test_linked_files_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    links = [link for link in re.findall(r"\]\(([^)]+)\)", text) if not link.startswith("https://")]
    for link in links:
        name, _, anchor = link.partition("#")
        target = (ROOT / page).parent / name if name else ROOT / page
        assert target.exists(), link
        titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE) if anchor else ()
        assert not anchor or anchor in {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}, (
            link
        )
    plain = re.findall(r"http://[^)\s]*", text)
    assert all(link.startswith("http://127.0.0.1:") for link in plain), "in the clear on this machine only"


def test_the_picture_is_one_and_small() -> None:
    picture = (ROOT / ".assets" / "height.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 300_000


def test_each_promise_names_tests_that_are_there() -> None:
    (promises,) = re.findall(r"^## What it promises\n(.*?)^## ", README, re.MULTILINE | re.DOTALL)
    for promise in promises.split("\n- ")[1:]:
        named = re.findall(r"`(tests/[\w/]+\.py)`", promise)
        assert named, promise
        assert all((ROOT / name).is_file() for name in named), named


@pytest.mark.parametrize("page", ["ARCHITECTURE.md"])
def test_modules_named_are_there(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    there = {
        path.name for folder in ("roughmap", "schemas", "service", "tests") for path in (ROOT / folder).rglob("*.py")
    }
    named = {Path(name).name for name in re.findall(r"`([\w/]+\.py)`", text)}
    assert named
    assert named <= there
