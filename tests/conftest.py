"""Puts the helpers beside it (`net`) within reach of every folder of tests; options and Hypothesis profiles."""

from pathlib import Path

import properties
import pytest

properties.register()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--storm-seconds", type=float, default=8.0, help="how long tests/storm lets all go on at once")
    parser.addoption("--require-prometheus", action="store_true", help="fail without prometheus and promtool")
    parser.addoption("--recordings", type=Path, metavar="FOLDER", help="recordings for tests/recordings")
    parser.addoption("--ros", type=Path, metavar="FOLDER", help="environments with ROS 2 for tests/ros")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out what needs recordings or a ROS 2 that a clone does not have."""
    needed = {"recordings": "--recordings", "ros": "--ros"}.get(collection_path.name)
    without = needed is not None and config.getoption(needed) is None
    return True if without and collection_path.parent == Path(__file__).parent else None
