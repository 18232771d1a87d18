"""Puts the helpers beside it (`net`) within reach of every folder of tests; options and Hypothesis profiles."""

from pathlib import Path

import properties
import pytest

properties.register()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--storm-seconds", type=float, default=8.0, help="how long tests/storm lets all go on at once")
    parser.addoption("--require-prometheus", action="store_true", help="fail without prometheus and promtool")
    parser.addoption("--recordings", type=Path, metavar="FOLDER", help="recordings for tests/recordings")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out what needs recordings that a clone does not have."""
    without = config.getoption("--recordings") is None
    return True if without and collection_path == Path(__file__).parent / "recordings" else None
