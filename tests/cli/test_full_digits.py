"""Numbers in the output of commands can be copied: no digits are missing, no exponents."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roughmap_service.cli.figures import metres, statistic


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (698361.6000000001, "698361.6"),
        (5949113.6, "5949113.6"),
        (-2.0, "-2"),
        (-1e-9, "0"),
        (1677721.6, "1677721.6"),
        (0.1, "0.1"),
        (100.0, "100"),
    ],
)
def test_metres(value: float, text: str) -> None:
    assert metres(value) == text


@given(st.floats(-1e9, 1e9))
def test_metres_read_back(value: float) -> None:
    text = metres(value)
    assert re.fullmatch(r"-?\d+(\.\d{1,6})?", text)
    assert float(text) == pytest.approx(value, abs=6e-7)


@pytest.mark.parametrize(
    ("value", "text"),
    [(5949.11937, "5949.119"), (123456.0, "123456"), (1.23456, "1.235"), (0.00012345, "0.0001234"), (1e20, "1e+20")],
)
def test_statistic(value: float, text: str) -> None:
    assert statistic(value) == text
