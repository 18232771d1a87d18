"""How a text file of points is written: its separator, decimal mark, header and columns, found from its first lines.

What could be read in two ways is refused with a remedy, never guessed.
"""

import csv
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from roughmap_service.formats.text_names import wanted_columns
from roughmap_service.formats.text_words import COMMA_NUMBER, COUNT, NO_NUMBER, NUMBER, Line, LineFault, shown

BLANKS = re.compile(r"[ \t\f\v]+")
ANY_SIGN = re.compile(r"[,;\s]+")

GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A number with a decimal comma, or of thousands with a separator."""


class Form(NamedTuple):
    """How the points of a file are written.

    `separator` is None for blanks; `comma` says that decimals have a comma. `wanted` are the columns of x, y and z,
    `columns` is the number of all; `header` is the line that names them. `first` is the number of the first line of
    points; `counted` says that the number of points stands before them.
    """

    separator: str | None
    comma: bool
    wanted: tuple[int, int, int]
    columns: int
    header: str | None
    first: int
    counted: bool


def split(text: str, separator: str | None) -> list[str]:
    """Return the fields of a line, without quotes and blanks around them; `separator` None is blanks."""
    if separator is None:
        return [word.strip("\"'") for word in BLANKS.split(text.strip(" \t\f\v"))]
    if '"' in text:
        return [field.strip() for field in next(csv.reader([text], delimiter=separator, skipinitialspace=True))]
    return [field.strip() for field in text.split(separator)]


def find_form(lines: Sequence[Line], remark: str | None) -> Form:
    """Find how `lines`, the first ones of a file, are written; there is at least one.

    `remark` is the last remark before them, which may name the columns. Raises LineFault.
    """
    top, body = lines[0], lines
    if ANY_SIGN.split(top.text)[0].lower() in {"ncols", "nrows"}:
        raise LineFault(
            top.number, "this is an ESRI ASCII grid, not points; convert it: gdal_translate -of XYZ GRID.asc POINTS.xyz"
        )
    counted = bool(COUNT.fullmatch(top.text)) and len(lines) > 1
    if counted:
        body = lines[1:]
        if COUNT.fullmatch(body[0].text):
            raise LineFault(top.number, "two counts, as in a PTX file; export the points as XYZ or PTS")
    header = body[0] if _is_header(body[0].text) else None
    if header is not None:
        body = body[1:]
    if not body:
        raise LineFault(top.number, f"no points after {shown(lines[-1].text)}; expected three numbers, x y z")
    separator = _separator(body[0], header)
    rows = [split(line.text, separator) for line in body]
    columns = len(rows[0])
    if header is not None:
        names = _names(header.text, separator, columns)
        wanted = wanted_columns(header.number, names)
        _check_width(body[0], columns, names, separator)
    elif columns < 3:
        raise LineFault(body[0].number, f"expected three numbers, x y z: {shown(body[0].text)}")
    else:
        wanted = _named_by(remark, separator, columns)
    comma = separator != "," and _decimal_comma(body, rows, wanted)
    if separator in {None, ","}:
        _check_cut(body, rows, separator, named=header is not None)
    return Form(separator, comma, wanted, columns, header and header.text.strip(), body[0].number, counted)


def _is_header(text: str) -> bool:
    """Return whether a line has names: words, and no numbers unless x, y and z are among the words."""
    words = [word for field in ANY_SIGN.split(text) if (word := field.strip("\"'"))]
    names = {word.lower() for word in words if not NUMBER.fullmatch(word) and not COMMA_NUMBER.fullmatch(word)}
    return any(name[0].isalpha() for name in names - NO_NUMBER) and (
        len(names) == len(words) or {"x", "y", "z"} <= names
    )


def _names(header: str, separator: str | None, columns: int) -> list[str]:
    """Return the names in a header, which may be separated by other signs than the numbers."""
    by_sign, by_any = split(header, separator), [name.strip("\"'") for name in ANY_SIGN.split(header.strip())]
    return by_any if len(by_sign) != columns == len(by_any) or len(by_sign) == 1 else by_sign


def _named_by(remark: str | None, separator: str | None, columns: int) -> tuple[int, int, int]:
    """Return the columns by a remark such as `# intensity x y z`, if it has a name for each, else the first three."""
    names = _names(remark or "", separator, columns)
    with suppress(LineFault):
        if len(names) == columns:
            return wanted_columns(0, names)
    return (0, 1, 2)


def _check_width(line: Line, columns: int, names: list[str], separator: str | None) -> None:
    if columns == len(names):
        return
    remedy = "name each column"
    if separator == "," and columns == 2 * len(names):
        remedy = "if these are decimal commas, write decimal points, or separate the columns by semicolons"
    raise LineFault(line.number, f"{columns} columns under {len(names)} names: {shown(line.text)}; {remedy}")


def _separator(line: Line, header: Line | None) -> str | None:
    """Return what separates the columns; None is blanks."""
    text = re.sub(r'"[^"]*"', "0", line.text)
    if ";" in text:
        return ";"
    fields = text.split("\t")
    if (header is not None and header.text.count("\t") >= 2) or (
        len(fields) >= 3 and all(field.strip() and not field.strip().endswith(",") for field in fields)
    ):
        return "\t"
    if "," not in text:
        return None
    words = BLANKS.split(text.strip())
    if len(words) >= 3 and all(COMMA_NUMBER.fullmatch(word) for word in words if "," in word):
        return None
    if any(len(parts) > 1 and all(map(NUMBER.fullmatch, parts)) for parts in map(str.split, text.split(","))):
        raise LineFault(
            line.number,
            f"commas may be decimal marks, separators or thousands: {shown(line.text)}; write decimal points, and "
            "separate all columns by the same sign",
        )
    return ","


def _decimal_comma(lines: Sequence[Line], rows: Sequence[Sequence[str]], wanted: tuple[int, int, int]) -> bool:
    """Return whether decimals have a comma. Numbers that may as well be thousands (1,234) are refused."""
    points = commas = certain = None
    for line, row in zip(lines, rows, strict=True):
        words = [row[k] for k in wanted if k < len(row)]
        with_comma = [word for word in words if COMMA_NUMBER.fullmatch(word)]
        commas = commas or (line if with_comma else None)
        points = points or (line if any("." in word and NUMBER.fullmatch(word) for word in words) else None)
        certain = certain or any(not GROUPED.fullmatch(word) for word in with_comma)
    if commas is None:
        return False
    if points is not None:
        later = max(points, commas)
        raise LineFault(later.number, f"decimal commas and points are mixed: {shown(later.text)}; write points in all")
    if not certain:
        raise LineFault(
            commas.number,
            f"commas may be decimal marks or thousands separators: {shown(commas.text)}; write decimal points, and "
            "thousands without a separator",
        )
    return True


def _check_cut(lines: Sequence[Line], rows: Sequence[Sequence[str]], separator: str | None, *, named: bool) -> None:
    """Refuse numbers that the separator seems to cut: thousands (1 234 567.5), or commas that are decimal marks too."""
    sign, mark = (r"[ \t]+", "[.,]") if separator is None else (",", r"\.")
    number = rf"[+-]?\d{{1,3}}(?:{sign}\d{{3}})*{mark}\d+"
    grouped = re.compile(rf"\s*{number}(?:{sign}{number}){{2,}}\s*")
    fewer = (len(re.findall(mark, line.text)) < len(row) for line, row in zip(lines, rows, strict=True))
    if all(grouped.fullmatch(line.text) for line in lines) and any(fewer):
        raise LineFault(
            lines[0].number,
            f"these may be numbers with thousands separators: {shown(lines[0].text)}; remove the separators",
        )
    if separator == "," and not named and len(rows[0]) in {6, 8, 10} and all(map(_whole, rows)):
        raise LineFault(
            lines[0].number,
            f"commas may be decimal marks as well as separators: {shown(lines[0].text)}; write decimal points, or "
            "separate the columns by semicolons, or name them in a first line",
        )


def _whole(row: Sequence[str]) -> bool:
    return all(field.lstrip("+-").isdigit() for field in row)
