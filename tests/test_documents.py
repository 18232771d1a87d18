"""What the documents say in figures and lists is what the code has: limits, problems, alerts."""

import re
from pathlib import Path

import pytest
import yaml

from roughmap import CELL_DTYPE
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_client.client import AGAIN_MOST_S
from roughmap_schemas import Config
from roughmap_schemas.layers import LAYERS
from roughmap_service.answers import queryables as answers
from roughmap_service.cli.health import WORKS
from roughmap_service.cli.serve import SWITCH_SECONDS
from roughmap_service.host import counters, disk, ending
from roughmap_service.journal import writer as log_writer
from roughmap_service.store import memory_limit as memory
from roughmap_service.store import snapshots
from roughmap_service.watch import readiness

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = Config()


def page(name: str) -> str:
    """A page's text, as one line."""
    return " ".join((ROOT / name).read_text(encoding="utf-8").split())


def rows(name: str, head: str) -> list[list[str]]:
    """The cells of the table whose head begins so, without the head."""
    text = (ROOT / name).read_text(encoding="utf-8")
    (table,) = re.findall(rf"^\| {head} \|.*\n\|[-|]+\n((?:\|.*\n)+)", text, re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


@pytest.mark.parametrize(
    ("name", "words", "value"),
    [
        ("OPERATIONS.md", "or has not answered for {:g} s: nothing is taken in", disk.HANG_SECONDS),
        ("OPERATIONS.md", "({:g} s without a tile taken", snapshots.HANG_SECONDS),
        ("OPERATIONS.md", "nothing was taken up for {:g} s", readiness.STALLED_SECONDS),
        ("OPERATIONS.md", "or were until {:g} s ago", counters.OVERLOAD_SECONDS),
        ("OPERATIONS.md", "written first; tried every {}", {1.0: "second"}.get(log_writer.RETRY_SECONDS)),
        ("OPERATIONS.md", "`map.memory_limit` ({:g} GiB)", DEFAULT.map.memory_limit / 2**30),
        ("OPERATIONS.md", "{:g} KiB a tile of 64 x 64 cells", SLOT_BYTES / 2**10),
        ("OPERATIONS.md", "lies in the spill file, {:g} bytes a cell", CELL_DTYPE.itemsize),
        ("OPERATIONS.md", "stored in `map.db` every {:g} s;", DEFAULT.store.snapshot_interval),
        ("OPERATIONS.md", "a snapshot every {:g} s: at most", DEFAULT.store.snapshot_interval),
        ("RELIABILITY.md", "after {:g} s it counts as a log that can't be written", disk.HANG_SECONDS),
        ("RELIABILITY.md", "twice as long each time, up to {:g} s", AGAIN_MOST_S),
        ("RELIABILITY.md", "an overload ends when none was dropped for {:g} s", counters.OVERLOAD_SECONDS),
        ("RELIABILITY.md", "threads give way after {:g} ms", SWITCH_SECONDS * 1000),
        ("README.md", "`height_tolerance` ({:g} cm in all)", DEFAULT.map.height_tolerance * 100),
        ("README.md", "`{}` has `/healthz`", DEFAULT.http.listen),
        ("CHANGELOG.md", "`log_not_writable` after {:g} s without an answer", disk.HANG_SECONDS),
        ("CHANGELOG.md", "delay the end by {:g} s at most", answers.CLOSE_SECONDS + ending.LINKS_SECONDS),
        ("CHANGELOG.md", "(1/{:g} of the limit,", 1 / memory.KEPT_SHARE),
        ("CHANGELOG.md", "at most {:g} MiB)", memory.MAX_KEPT_BYTES / 2**20),
    ],
)
def test_a_figure_is_the_codes(name: str, words: str, value: object) -> None:
    assert words.format(value) in page(name)


def test_every_problem_is_told_with_what_ready_and_health_say() -> None:
    told = {}
    for problems, _, answers_, _ in rows("OPERATIONS.md", "problem"):
        told |= dict.fromkeys(re.findall(r"`(\w+)`", problems), answers_)
    assert told == {
        str(one): f"{200 if readiness.is_ready([one]) else 503}, {0 if str(one) in WORKS else 1}"
        for one in readiness.Problem
    }


def test_every_alert_is_told_and_no_other() -> None:
    rules = yaml.safe_load((ROOT / "docker" / "alerts.yaml").read_text(encoding="utf-8"))["groups"]
    told = [name for row in rows("OPERATIONS.md", "alert") for name in re.findall(r"\w+", row[0])]
    assert sorted(told) == sorted(rule["alert"] for group in rules for rule in group["rules"])


def test_the_layers_of_the_readme_are_all_there_are() -> None:
    told = [name for row in rows("README.md", "layer") for name in re.findall(r"\w+", row[0])]
    assert sorted(told) == sorted(LAYERS)
