"""Recorded clouds in text files: points in the map frame, one per line, in metres.

Columns are separated by semicolons, tabs, commas or blanks, the same all over the file. They are those that a header
names (x, y, z; Easting, Northing, Elevation; ...), else the first three. Decimals have a point; a comma too where it
can't be a separator. A count of the points may come first, as in PTS files. Text after # or // is ignored, but for
names of all columns just before the points. A word such as nan, or no word, is NaN. A file is never read as a whole.
"""

import re
from collections.abc import Iterator
from io import TextIOWrapper
from itertools import repeat
from pathlib import Path
from typing import TextIO

import numpy as np

from roughmap_service.formats.options import ReadOptions
from roughmap_service.formats.recorded import PART_ROWS, CloudFileFault, Floats, PlacedPoints
from roughmap_service.formats.text_form import Form, find_form, split
from roughmap_service.formats.text_words import COUNT, Line, LineFault, coordinate, shown

BLOCK = 6 * PART_ROWS
"""Characters read at once. A line of three numbers has at least six."""

MAX_LINE = 1 << 16
"""Most characters of a line."""

FORM_LINES = 1000
"""Lines that the form of a file is found from."""

REMARK = re.compile(r"(?:^|(?<=[\s,;]))(?:#(?!N/A)|//)")


def read_text(file: Path, options: ReadOptions) -> Iterator[PlacedPoints]:
    """Return the points of a file in parts. Raises CloudFileFault and OSError."""
    with file.open("rb") as raw:
        encoding = "utf-16" if raw.read(2) in {b"\xff\xfe", b"\xfe\xff"} else "utf-8"
        size = raw.seek(0, 2)
    reader = _Reader()
    with file.open("rb") as raw, TextIOWrapper(raw, encoding, errors="replace") as stream:
        try:
            for first, lines in _blocks(stream):
                points = reader.read(first, lines)
                if len(points):
                    yield PlacedPoints(points, 0, None)
                options.reached(min(1.0, raw.tell() / size))
            reader.end()
        except LineFault as fault:
            raise CloudFileFault(f"{file}, line {fault.number}: {fault.text}") from fault


def _blocks(stream: TextIO) -> Iterator[tuple[int, list[str]]]:
    """Return the file's lines in blocks, each with the number of its first line."""
    number, rest = 1, ""
    while block := stream.read(BLOCK):
        if "\0" in block:
            raise LineFault(
                number + block[: block.index("\0")].count("\n"), "binary data; expected a text file of points"
            )
        text = rest + block.replace("\ufeff", "")
        lines = text.split("\n")
        rest = lines.pop() if len(block) == BLOCK else ""
        if max(map(len, (*lines, rest))) > MAX_LINE:
            bad = next(k for k, line in enumerate((*lines, rest), number) if len(line) > MAX_LINE)
            raise LineFault(bad, f"longer than {MAX_LINE} characters; expected three numbers")
        yield number, lines
        number += len(lines)
    if rest:
        yield number, [rest]


class _Reader:
    """Reads blocks of lines in order; the first ones decide about the form."""

    def __init__(self) -> None:
        self._form: Form | None = None
        self._remark: str | None = None
        """The last remark before the first line that is none."""
        self._count: Line | None = None
        """The last line with a count of points."""
        self._points = 0
        """Points since then."""

    def read(self, first: int, lines: list[str]) -> Floats:
        """Return the points of a block, (N, 3), NaN where there is no number; `first` is its first line's number."""
        form = self._form
        if form is None:
            kept = self._kept(first, lines)
            if not kept:
                return np.empty((0, 3))
            self._form = form = find_form(kept[:FORM_LINES], self._remark)
            self._count = kept[0] if form.counted else None
            first, lines = form.first, lines[form.first - first :]
        points = _at_once(form, lines)
        if points is None:
            return self._line_by_line(form, self._kept(first, lines))
        self._points += len(points)
        return points

    def end(self) -> None:
        """Check that as many points followed as the last count says, if there was one."""
        if self._count is not None and int(self._count.text) != self._points:
            raise LineFault(
                self._count.number,
                f"a count of {int(self._count.text)} points, but {self._points} follow; if none is missing, delete "
                "this line",
            )

    def _kept(self, first: int, lines: list[str]) -> list[Line]:
        """Return the lines that have more than a remark."""
        kept = []
        for number, line in enumerate(lines, first):
            found = REMARK.search(line)
            text = line[: found.start()] if found else line
            if text and not text.isspace():
                kept.append(Line(number, text))
            elif found and self._form is None and not kept:
                self._remark = line[found.end() :].strip("#/ ")
        return kept

    def _line_by_line(self, form: Form, lines: list[Line]) -> Floats:
        rows = []
        for line in lines:
            text = line.text.strip()
            if text == form.header:
                continue  # two files, one after the other
            if form.counted and COUNT.fullmatch(text):
                self.end()
                self._count, self._points = line, 0
                continue
            rows.append(_row(form, line))
            self._points += 1
        return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _at_once(form: Form, lines: list[str]) -> Floats | None:
    """Return the points of plain lines; None if any is not as the form says, or has a remark, quotes or a sign."""
    text = "\n".join(lines)
    if not text.isascii() or any(sign in text for sign in ("#", "//", '"', "'")) or (form.comma and "." in text):
        return None
    if form.comma:
        lines = text.replace(",", ".").split("\n")
    lines = list(filter(str.strip, lines))
    if not lines:
        return np.empty((0, 3))
    few = form.columns == 3  # numpy itself checks the number of columns, if it is to read all of them
    if not few and set(_widths(form, lines)) != {form.columns}:
        return None
    try:
        points = np.loadtxt(
            lines, delimiter=form.separator, usecols=None if few else form.wanted, comments=None, ndmin=2
        )
    except ValueError:
        return None
    if points.shape[1] != 3:
        return None
    return points[:, form.wanted] if few else points


def _widths(form: Form, lines: list[str]) -> Iterator[int]:
    if form.separator is None:
        return map(len, map(str.split, lines))
    return (count + 1 for count in map(str.count, lines, repeat(form.separator)))


def _row(form: Form, line: Line) -> list[float]:
    """Return x, y and z of a line."""
    fields = split(line.text, form.separator)
    try:
        values = [coordinate(fields[k], form.comma) for k in form.wanted if k < len(fields)]
    except ValueError as error:
        what, remedy = error.args
        raise LineFault(line.number, f"{what}: {shown(line.text)}; {remedy}") from error
    if len(fields) != form.columns:
        raise LineFault(
            line.number,
            f"{len(fields)} columns, but {form.columns} in line {form.first}: {shown(line.text)}; complete or "
            "delete it",
        )
    return values
