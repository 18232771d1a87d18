"""Stands here so that the helpers beside it (`net`) can be imported from every folder of tests."""

import properties
import pytest

properties.register()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--storm-seconds", type=float, default=8.0, help="how long tests/storm lets all go on at once")
