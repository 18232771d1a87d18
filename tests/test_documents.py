"""Figures, settings and lists in the documents equal those in the code: limits, problems, alerts, events, layers."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from roughmap.tiles.columns import COLUMN_BYTES
from roughmap.tiles.slots import SLOT_BYTES
from roughmap_client.client import MAX_RETRY_S
from roughmap_schemas import Config
from roughmap_schemas.layers import LAYERS
from roughmap_service.cli.health import WORKS
from roughmap_service.cli.serve import SWITCH_SECONDS
from roughmap_service.host import counters, disk
from roughmap_service.inputs import losses
from roughmap_service.journal import writer as log_writer
from roughmap_service.store import snapshots
from roughmap_service.watch import readiness

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = Config()


PAGES = ("README.md", "OPERATIONS.md", "RELIABILITY.md", "SECURITY.md", "docker/alerts.yaml")

UNITS = {"s": 1.0, "ms": 1e-3, "cm": 1e-2, "KiB": 2.0**10, "MiB": 2.0**20, "GiB": 2.0**30}


def page(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def rows(name: str, head: str) -> list[list[str]]:
    """The cells of the table whose first column has this head, without the head."""
    (table,) = re.findall(rf"^\| {head} \|.*\n\|[-|]+\n((?:\|.*\n)+)", page(name), re.MULTILINE)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def names(name: str, head: str) -> list[str]:
    """All names in the first column of a table."""
    return [word for row in rows(name, head) for word in re.findall(r"\w+", row[0])]


def settings() -> dict[str, Any]:
    """Every setting by its dotted name, with its default."""
    return {
        f"{section}.{name}": value
        for section, values in DEFAULT.model_dump().items()
        for name, value in values.items()
        if isinstance(values, dict)
    }


@pytest.mark.parametrize(
    ("name", "head", "row", "value", "unit"),
    [
        ("OPERATIONS.md", "problem", "`log_not_writable`", disk.HANG_SECONDS, "s"),
        ("OPERATIONS.md", "problem", "`log_not_writable`", log_writer.RETRY_SECONDS, "s"),
        ("OPERATIONS.md", "problem", "`snapshot_failed`", snapshots.HANG_SECONDS, "s"),
        ("OPERATIONS.md", "problem", "`sequencer_stalled`", readiness.STALLED_SECONDS, "s"),
        ("OPERATIONS.md", "problem", "`input_lost`", losses.WINDOW, "s"),
        ("OPERATIONS.md", "problem", "`input_lost`", losses.SILENT, "s"),
        ("OPERATIONS.md", "problem", "`input_lost`", 100 * losses.SHARE, "%"),
        ("OPERATIONS.md", "problem", "`overloaded`", counters.OVERLOAD_SECONDS, "s"),
        ("OPERATIONS.md", "resource", "memory of the map", SLOT_BYTES / 2**10, "KiB"),
        ("OPERATIONS.md", "resource", "a map larger than memory", (SLOT_BYTES + COLUMN_BYTES) / 4096, "bytes"),
        ("RELIABILITY.md", "fault", "disk that hangs", disk.HANG_SECONDS, "s"),
        ("RELIABILITY.md", "fault", "link cut, held up", MAX_RETRY_S, "s"),
        ("RELIABILITY.md", "load", "twice as many scans", counters.OVERLOAD_SECONDS, "s"),
        ("RELIABILITY.md", "load", "twice as many scans", SWITCH_SECONDS * 1000, "ms"),
    ],
)
def test_a_rows_figure_is_the_codes(name: str, head: str, row: str, value: float, unit: str) -> None:
    (cells,) = [cells for cells in rows(name, head) if cells[0].startswith(row)]
    assert re.search(rf"(?<![\d.]){value:g} {unit}(?!\w)", " ".join(cells[1:]))


@pytest.mark.parametrize("name", PAGES)
def test_settings_named_exist_with_the_default_beside_them(name: str) -> None:
    """`section.name` is a setting; a number in parentheses right after it is its default."""
    known = settings()
    sections = "|".join(DEFAULT.model_dump().keys() - {"sensors", "robots"})
    mark = "`" if name.endswith(".md") else ""
    setting = rf"((?:{sections})\.(?!db\b)[a-z_]+)"
    named = re.findall(rf"{mark}\b{setting}(?: = [^`]*)?{mark}(?: \(([\d.]+) (\w+)\))?", page(name))
    for one, number, unit in named:
        assert one in known
        assert not number or float(number) * UNITS[unit] == pytest.approx(known[one]), one


def test_the_readme_names_the_pages_address() -> None:
    assert f"`http://{DEFAULT.http.listen}`" in page("README.md")


def test_every_problem_is_listed_with_its_codes() -> None:
    listed = {}
    for problems, _, codes, _ in rows("OPERATIONS.md", "problem"):
        listed |= dict.fromkeys(re.findall(r"`(\w+)`", problems), codes)
    assert listed == {
        str(one): f"{200 if readiness.is_ready([one]) else 503}, {0 if str(one) in WORKS else 1}"
        for one in readiness.Problem
    }


def test_every_alert_is_listed() -> None:
    groups = yaml.safe_load(page("docker/alerts.yaml"))["groups"]
    rules = [rule["alert"] for group in groups for rule in group["rules"]]
    assert sorted(names("OPERATIONS.md", "alert")) == sorted(rules)


def test_every_event_of_a_log_line_is_listed() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "service" / "roughmap_service").rglob("*.py")]
    # In `note(logger, logging.INFO, "robot", ...)` and in the notices' `self._tell(subject, "leap", ...)`.
    said = r"(?:logging\.[A-Z]+|self\._tell\([^,]+),\s*\"(\w+)\""
    known = {event for source in sources for event in re.findall(said, source)}
    assert set(names("OPERATIONS.md", "event")) == known


def test_every_layer_is_listed() -> None:
    assert sorted(names("README.md", "layer")) == sorted(LAYERS)
