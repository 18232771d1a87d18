"""Recorded clouds in text files: points in the map frame, one per line, in metres.

Columns are separated by blanks, tabs, commas or semicolons. They are those named x, y and z if the first line has these
names, else the first three. Text after # or // is ignored. A file is never read as a whole.
"""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats, PlacedPoints


def read_text(file: Path) -> Iterator[PlacedPoints]:
    """Return the points of a file in parts. Raises CloudFileFault and OSError."""
    with file.open(encoding="utf-8", errors="replace") as lines:
        columns: tuple[int, int, int] | None = None
        number = 0
        while chunk := list(itertools.islice(lines, PART_ROWS)):
            rows: list[tuple[str, str, str]] = []
            for line in chunk:
                number += 1
                words = _words(line)
                if not words:
                    continue
                if columns is None:
                    columns, is_header = _columns(words)
                    if is_header:
                        continue
                if len(words) <= max(columns):
                    raise CloudFileFault(
                        f"{file}:{number}: expected at least {max(columns) + 1} columns: {line.strip()[:60]!r}"
                    )
                rows.append((words[columns[0]], words[columns[1]], words[columns[2]]))
            if rows:
                yield PlacedPoints(_numbers(file, rows, number - len(chunk) + 1), 0, None)


def _words(line: str) -> list[str]:
    text = line.split("#", 1)[0].split("//", 1)[0]
    return text.replace(",", " ").replace(";", " ").split()


def _columns(words: list[str]) -> tuple[tuple[int, int, int], bool]:
    """Return the columns of x, y and z, and whether the first line (``words``) is a header."""
    names = [word.strip("\"'").lower() for word in words]
    if {"x", "y", "z"} <= set(names):
        return (names.index("x"), names.index("y"), names.index("z")), True
    return (0, 1, 2), False


def _numbers(file: Path, rows: list[tuple[str, str, str]], first_line: int) -> Floats:
    try:
        return np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise CloudFileFault(f"{file}: near line {first_line}: expected three numbers per line ({error})") from error
