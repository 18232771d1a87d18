"""What came of walks, as a table and as lines."""

from collections.abc import Sequence
from typing import Any

import walks_paths  # noqa: F401 - before what it makes importable
from walk_sender import Walk

WHO = ("log", "health", "doctor", "ended", "pasted")


def cell(walk: Walk, who: str, limit: float) -> str:
    """ "yes 1.2", "NO", or "-" where it need not be named."""
    names = walk.fault.names
    asked = {
        "log": names.log, "health": names.health, "doctor": names.doctor,
        "ended": walk.told.health is not None and walk.kind.ends, "pasted": "pasted" in walk.told.said,
    }  # fmt: skip
    if not asked[who]:
        return "-"
    seconds = getattr(walk.told, who)
    if seconds is None:
        return "NO"
    return f"{'yes' if seconds <= limit else 'LATE'} {seconds:.1f} s"


def table(walks: Sequence[Walk], limit: float) -> str:
    """A row for each fault: who named it after how many seconds, and when its problem ended."""
    rows = [("fault", "drawn", *WHO)]
    rows += [(walk.kind.title, walk.fault.told, *(cell(walk, who, limit) for who in WHO)) for walk in walks]
    widths = [max(len(row[n]) for row in rows) for n in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)) for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def findings(walks: Sequence[Walk], limit: float) -> list[str]:
    """What is not as it should be."""
    found = []
    for walk in walks:
        for who in WHO:
            said = cell(walk, who, limit)
            if not said.startswith(("yes", "-")):
                words = walk.told.said.get(who, "nothing")
                found.append(f"{walk.name} ({walk.fault.told}): {who} {said}; it said: {words}")
        found += [f"{walk.name}: {text}" for text in walk.told.wrong]
    return found


def as_json(walks: Sequence[Walk]) -> list[dict[str, Any]]:
    """The same with all words."""
    return [
        {
            "fault": walk.name, "drawn": walk.fault.told, **{who: getattr(walk.told, who) for who in WHO},
            "wrong": walk.told.wrong, "said": walk.told.said,
        }
        for walk in walks
    ]  # fmt: skip
