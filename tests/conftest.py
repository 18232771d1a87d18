"""Puts the helpers beside it (`net`) within reach of every folder of tests; options and Hypothesis profiles."""

import logging
from collections.abc import Iterator
from pathlib import Path

import properties
import pytest

from roughmap_service.host.log_lines import Lines

properties.register()

FIRST = (
    "test_other_cpus.py", "test_rejections.py", "test_unchanged_tiles.py", "test_ground_layers.py",
    "test_bench.py", "test_ends_and_starts.py", "test_closed_unsynced.py", "test_kills_and_cuts.py",
    "test_faults.py", "test_soak.py", "test_storm.py", "test_walks.py", "test_fuzz.py", "test_doctor_robots.py",
    "test_demo.py",
)  # fmt: skip
"""Files that take half a minute or more: one that came last would run alone, beside an idle core. Before those that
start services come some that compile the kernels, which services then find in the cache."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--storm-seconds", type=float, default=8.0, help="how long tests/storm lets all go on at once")
    parser.addoption("--require-prometheus", action="store_true", help="fail without prometheus and promtool")
    parser.addoption("--recordings", type=Path, metavar="FOLDER", help="recordings for tests/recordings")
    parser.addoption("--ros", type=Path, metavar="FOLDER", help="environments with ROS 2 for tests/ros")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files of `FIRST`. xdist keeps this order with --no-loadscope-reorder only."""
    order = {name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out what needs recordings or a ROS 2 that a clone does not have."""
    needed = {"recordings": "--recordings", "ros": "--ros"}.get(collection_path.name)
    without = needed is not None and config.getoption(needed) is None
    return True if without and collection_path.parent == Path(__file__).parent else None


@pytest.fixture(autouse=True)
def _log_lines_end_with_the_test() -> Iterator[None]:
    """A command that ran within the test sent all log lines to that test's stderr, which is closed afterwards."""
    root = logging.getLogger()
    level = root.level
    yield
    for handler in [handler for handler in root.handlers if isinstance(handler, Lines)]:
        root.removeHandler(handler)
        root.setLevel(level)
