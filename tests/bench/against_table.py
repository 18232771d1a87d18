"""The table that compares two versions: medians, and the median and quartiles of the pairs' own ratios."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from against_rows import Spec
from figures import Mark
from table import aligned, bound_text, short

HEAD = ("row", "what", "unit", "better", "old", "new", "new / old", "quartiles", "pairs", "new is", "mark", "met")
DIGITS = 2
"""Of a ratio, after the point."""

ENOUGH = 3
"""Pairs: fewer say nothing of what is better."""


@dataclass
class Compared:
    """A row. ``old``, ``new``: a value for each pair, None where there is none, and ``why``."""

    spec: Spec
    mark: Mark | None
    old: list[float | None] = field(default_factory=list)
    new: list[float | None] = field(default_factory=list)
    why: dict[str, str] = field(default_factory=dict)
    """By the version's name."""

    @property
    def ratios(self) -> list[float]:
        """New over old of each pair that has both."""
        return [n / o for o, n in zip(self.old, self.new, strict=True) if o is not None and n is not None]

    @property
    def quartiles(self) -> tuple[float, float, float] | None:
        """Lower quartile, median, upper quartile of the ratios."""
        if not self.ratios:
            return None
        low, middle, high = np.percentile(self.ratios, [25, 50, 75]).tolist()
        return low, middle, high

    @property
    def verdict(self) -> str:
        """What the new version is: even where the quartiles, as shown, lie on both sides of 1."""
        if self.quartiles is None or len(self.ratios) < ENOUGH:
            return ""
        low, _, high = (round(value, DIGITS) for value in self.quartiles)
        if low <= 1.0 <= high:
            return "even"
        return "better" if (low > 1.0) == self.spec.more else "worse"

    @property
    def met(self) -> bool | None:
        """None where no mark is set, or nothing was measured."""
        value, quartiles = median(self.new), self.quartiles
        if self.mark is None or value is None:
            return None
        return self.mark.met(value, None if quartiles is None else quartiles[1])

    def record(self) -> dict[str, Any]:
        """The row as JSON values."""
        low, middle, high = self.quartiles or (None, None, None)
        return {
            "key": self.spec.key, "figure": self.spec.figure, "unit": self.spec.unit,
            "better": "more" if self.spec.more else "less", "old": median(self.old), "new": median(self.new),
            "ratio": middle, "low": low, "high": high, "new_is": self.verdict, "mark": mark_text(self), "met": self.met,
            "old_samples": self.old, "new_samples": self.new, "why": self.why,
        }  # fmt: skip


def median(samples: Sequence[float | None]) -> float | None:
    """Of those that are there; None if there is none."""
    there = [value for value in samples if value is not None]
    return float(np.median(there)) if there else None


def mark_text(row: Compared) -> str:
    """The mark as a condition on what it is for: `new >= 1.7`, `new / old <= 0.85`."""
    if row.mark is None:
        return ""
    return bound_text("new" if row.mark.of == "value" else "new / old", row.mark)


def lines(rows: Sequence[Compared]) -> list[str]:
    """The table, then why what is missing is missing."""
    text = aligned(HEAD, [_cells(row) for row in rows])
    why = [f"- {row.spec.key}: {name}: {said}" for row in rows for name, said in row.why.items()]
    return [*text, *(["", "Not measured, or not every time:", *why] if why else [])]


def _cells(row: Compared) -> tuple[str, ...]:
    old, new = (short(median(side)) or f"none: {row.why.get(name, 'no value')}"[:60]
                for name, side in (("old", row.old), ("new", row.new)))  # fmt: skip
    low, middle, high = row.quartiles or (None, None, None)
    spread = f"{ratio(low)} .. {ratio(high)}" if row.ratios else ""
    better, met = "more" if row.spec.more else "less", {None: "", True: "yes", False: "NO"}[row.met]
    return (
        row.spec.key, row.spec.figure, row.spec.unit, better, old, new, ratio(middle), spread, str(len(row.ratios)),
        row.verdict, mark_text(row), met,
    )  # fmt: skip


def ratio(value: float | None) -> str:
    """As the table shows it."""
    return "" if value is None else f"{value:.{DIGITS}f}"
