"""Words and lines of text files of points, and the fault of a line."""

import re
from typing import NamedTuple

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?", re.ASCII)
COUNT = re.compile(r"\s*\d{1,12}\s*", re.ASCII)

THOUSANDS = re.compile(r"[+-]?\d+([,.' \u00a0\u202f\u2019_]\d+)+")

NO_NUMBER = frozenset((
    "", "nan", "+nan", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "na", "n/a", "#n/a",
    "null", "none", "inf", "+inf", "-inf", "infinity", "+infinity", "-infinity", "1.#inf", "-1.#inf",
))  # fmt: skip
"""How programs write that there is no (finite) number, in small letters."""


class LineFault(Exception):
    """A line can't be read. `number` counts from 1; `text` says what was found and what to do."""

    def __init__(self, number: int, text: str) -> None:
        super().__init__(number, text)
        self.number, self.text = number, text


class Line(NamedTuple):
    """A line that is neither empty nor a remark, without its remark; `number` counts from 1."""

    number: int
    text: str


def shown(text: str) -> str:
    """Return the beginning of a line in quotes."""
    text = text.strip()
    return repr(text if len(text) <= 60 else text[:57] + "...")


def coordinate(word: str, comma: bool) -> float:
    """Return the number that a word stands for, NaN for none; `comma`: its decimals have a comma.

    Raises ValueError(what is wrong, what to do).
    """
    if NUMBER.fullmatch(word) and not (comma and "." in word):
        return float(word)
    if comma and COMMA_NUMBER.fullmatch(word):
        return float(word.replace(",", "."))
    if word.lower() in NO_NUMBER:
        return float("nan")
    if comma and NUMBER.fullmatch(word):
        raise ValueError(f"{shown(word)} has a decimal point where others have decimal commas", "write points in all")
    if COMMA_NUMBER.fullmatch(word):
        raise ValueError(f"{shown(word)} has a decimal comma", "write decimal points")
    if THOUSANDS.fullmatch(word):
        raise ValueError(f"{shown(word)} has thousands separators", "remove them, and write decimal points")
    raise ValueError(f"{shown(word)} is not a number", "if this is not a point, delete the line or put # before it")
