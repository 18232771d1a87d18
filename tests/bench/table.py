"""The benchmark's one table, for the eye and as JSON."""

import json
import math
import os
import platform
from collections.abc import Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from figures import Mark, Row

HEAD = ("figure", "mark", "measured", "spread", "reference", "ratio", "met")


def machine() -> dict[str, Any]:
    """What it ran on."""
    model = ""
    cpus = Path("/proc/cpuinfo")
    if cpus.exists():
        model = next(
            (line.split(":", 1)[1].strip() for line in cpus.read_text().splitlines() if "model name" in line), ""
        )
    installed = {found.name: found.version for found in distributions()}
    return {
        "cpu": model or platform.processor(),
        "cores": len(os.sched_getaffinity(0)),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        **{name: installed[name] for name in ("numpy", "numba", "eclipse-zenoh", "mcap") if name in installed},
    }


def as_json(rows: list[Row], **about: Any) -> str:
    """All rows with their samples; no NaN in it."""
    return json.dumps(
        {**about, "machine": machine(), "rows": [_record(row) for row in rows]}, allow_nan=False, indent=1
    )


def _record(row: Row) -> dict[str, Any]:
    return {
        "key": row.key,
        "figure": row.figure,
        "unit": row.unit,
        "value": _number(row.value),
        "low": _number(row.low),
        "high": _number(row.high),
        "mark": mark_text(row),
        "reference": row.reference,
        "reference_value": _number(row.reference_value),
        "ratio": _number(row.ratio),
        "met": row.met,
        "note": row.note,
        "samples": [_number(value) for value in row.samples],
        "reference_samples": [_number(value) for value in row.beside],
    }


def _number(value: float | None) -> float | None:
    return float(f"{value:.6g}") if value is not None and math.isfinite(value) else None


def mark_text(row: Row) -> str:
    """The mark as a condition: `<= 45 ns a point`, `>= 0.9 x`."""
    mark = row.mark
    if mark is None:
        return ""
    return f"{bound_text('', mark)} {'x' if mark.of == 'ratio' else row.unit}".strip()


def bound_text(what: str, mark: Mark) -> str:
    """The condition on ``what``, without unit."""
    return f"{what} {'>=' if mark.least else '<='} {short(mark.bound)}".strip()


def short(value: float | None) -> str:
    """Three figures, thousands parted."""
    if value is None or not math.isfinite(value):
        return ""
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def lines(rows: list[Row]) -> list[str]:
    """The table as Markdown that also reads as text."""
    return aligned(HEAD, [_cells(row) for row in rows])


def aligned(head: Sequence[str], full: Sequence[Sequence[str]]) -> list[str]:
    """A Markdown table of such lines under ``head``, without columns that say nothing."""
    kept = [k for k in range(len(head)) if any(line[k] for line in full)]
    cells = [[line[k] for k in kept] for line in (head, *full)]
    wide = [max(len(line[k]) for line in cells) for k in range(len(kept))]
    text = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, wide, strict=True)) + " |" for line in cells]
    return [text[0], "|" + "|".join("-" * (w + 2) for w in wide) + "|", *text[1:]]


def _cells(row: Row) -> tuple[str, ...]:
    measured = f"{short(row.value)} {row.unit}" if math.isfinite(row.value) else f"not measured: {row.note}"
    spread = f"{short(row.low)} .. {short(row.high)}" if math.isfinite(row.low) else ""
    reference = f"{row.reference}: {short(row.reference_value)}" if row.reference_value is not None else row.reference
    met = {None: "", True: "yes", False: "NO"}[row.met]
    return row.figure, mark_text(row), measured, spread, reference, short(row.ratio), met
