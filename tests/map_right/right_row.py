"""A figure of the map's rightness, what it is held to, and the table of them."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

HEAD = ("judged on", "figure", "mark", "measured", "paper's method", "met", "how")


@dataclass(frozen=True)
class Row:
    """One figure. ``mark``: it is met if ``value`` is at most that, or at least that where ``least``; None is a figure
    that only informs. ``before``: the same figure under surface "all"."""

    on: str
    figure: str
    unit: str
    value: float
    mark: float | None = None
    least: bool = False
    before: float | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """None without a mark. What could not be measured is missed."""
        if self.mark is None:
            return None
        if not math.isfinite(self.value):
            return False
        return self.value >= self.mark if self.least else self.value <= self.mark

    def record(self) -> dict[str, Any]:
        """The row as JSON values; NaN is None."""
        values = asdict(self) | {"met": self.met}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def percent(chosen: np.ndarray) -> float:
    """Share of True in percent; NaN of nothing."""
    return 100.0 * float(chosen.mean()) if chosen.size else math.nan


def lines(rows: Sequence[Row]) -> list[str]:
    """The table as Markdown that also reads as text, and one line that counts."""
    full = [HEAD, *(_cells(row) for row in rows)]
    wide = [max(len(line[k]) for line in full) for k in range(len(HEAD))]
    text = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, wide, strict=True)) + " |" for line in full]
    marked = [row.met for row in rows if row.met is not None]
    rule = "|" + "|".join("-" * (w + 2) for w in wide) + "|"
    return [text[0], rule, *text[1:], "", f"{sum(marked)} of {len(marked)} marks are met."]


def _cells(row: Row) -> tuple[str, ...]:
    mark = "" if row.mark is None else f"{'>=' if row.least else '<='} {row.mark:g} {row.unit}"
    met = {None: "", True: "yes", False: "NO"}[row.met]
    value = f"{_short(row.value)} {row.unit}" if math.isfinite(row.value) else "not measured"
    return row.on, row.figure, mark, value, "" if row.before is None else _short(row.before), met, row.note


def _short(value: float) -> str:
    return f"{value:.0f}" if value == round(value) or abs(value) >= 1000 else f"{value:.3g}"
