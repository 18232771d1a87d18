"""The screen of `roughmap top`: status and robots as tables."""

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from roughmap_schemas import IntegrationEvent, decode_event
from roughmap_schemas.faults import ContractError
from roughmap_schemas.messages import MapStatus
from roughmap_schemas.reasons import MEANING, CloudReason, PointReason, PoseReason, Reason, Refusal
from roughmap_service.host.log_growth import growth_text
from roughmap_service.host.log_lines import printable

WINDOW_S = 10.0
"""Seconds over which a robot's rates are averaged, as in the status."""

MAX_ROBOTS = 256
"""Robots listed: the default of ``input.max_robots``."""

MAX_EVENTS = 4096
"""Events of a robot kept for its rates."""

STYLES = {"ok": "bold green", "overloaded": "bold yellow", "degraded": "bold red"}


@dataclass
class Robot:
    """Decisions on one robot's clouds since the command started."""

    recent: deque[tuple[float, int]] = field(default_factory=lambda: deque(maxlen=MAX_EVENTS))
    integrated: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class Row:
    """One robot's line: rates over the last `WINDOW_S`, counts since the command started."""

    name: str
    clouds_per_s: float
    points_per_s: float
    integrated: int
    rejected: Mapping[str, int]


class Robots:
    """Collects the service's published events by robot."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._robots: dict[str, Robot] = {}
        self._begun = time.monotonic()

    def take(self, payload: bytes) -> None:
        """Count one published event; any but an integration is ignored."""
        try:
            event = decode_event(payload)
        except ContractError:
            return  # from a service of another version
        if not isinstance(event, IntegrationEvent):
            return
        with self._lock:
            if event.robot not in self._robots and len(self._robots) >= MAX_ROBOTS:
                return
            robot = self._robots.setdefault(event.robot, Robot())
            if event.accepted:
                robot.integrated += 1
                robot.recent.append((time.monotonic(), event.accepted))
            else:
                robot.rejected[str(event.outcome)] += 1

    def rows(self) -> list[Row]:
        """Return the robots, sorted by name."""
        now = time.monotonic()
        since, window = now - WINDOW_S, max(min(now - self._begun, WINDOW_S), 0.1)
        with self._lock:
            rows = []
            for name, robot in sorted(self._robots.items()):
                recent = [points for at, points in robot.recent if at >= since]
                rates = len(recent) / window, sum(recent) / window
                rows.append(Row(name, *rates, robot.integrated, dict(robot.rejected)))
            return rows


def frame(status: MapStatus, robots: list[Row], silent_s: float) -> RenderableType:
    """Return the whole screen; ``silent_s`` is the time since the service last answered, in seconds."""
    parts: list[RenderableType] = [_head(status, silent_s), *_problems(status), Text(), _flow(status), Text()]
    parts.append(_resources(status))
    if rejected := _rejected(status):
        parts += [Text(), rejected]
    if robots or status.gaps or status.jumps:
        parts += [Text(), _robots(status, robots)]
    return Group(*parts)


def _head(status: MapStatus, silent_s: float) -> Text:
    head = Text.assemble(
        (printable(status.map), "bold"), "  ", (status.health, STYLES[status.health]),
        f"  sequence {status.sequence:,}",
        f" ({status.durable_sequence:,} on disk)  epoch {status.epoch}  up {_duration(status.uptime_s)}",
        (f"\nroughmap {printable(status.version)}, instance {printable(status.instance[:8])}", "dim"),
    )  # fmt: skip
    if silent_s >= 2.0:
        head.append(f"\nno answer for {silent_s:.0f} s; showing the last status", "bold red")
    return head


def _problems(status: MapStatus) -> list[RenderableType]:
    """Return a line for each problem: its sentence, with the subject if it does not begin with that. Then those on what
    happened lately."""
    shown = []
    for subject, text in status.problems.items():
        line = text if text.startswith(subject) else f"{subject}: {text}"
        shown.append(Text(printable(line), "yellow"))
    shown += [Text(printable(f"recently: {text}"), "dim") for text in status.recent]
    return [Text(), *shown] if shown else []


def _table(*columns: str, left: tuple[str, ...] = ()) -> Table:
    """Return a table with a column of names, columns of numbers, and columns of texts (``left``)."""
    table = Table(box=None, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left", header_style="dim")
    for column in left:
        table.add_column(column, header_style="dim")
    return table


def _flow(status: MapStatus) -> Table:
    clouds, points, poses = status.clouds, status.points, status.poses
    table = _table("", "per second", "accepted", "rejected", "waiting")
    rows = (("clouds", clouds, f"{clouds.waiting:,}"), ("points", points, ""), ("poses", poses, ""))
    for name, counts, waiting in rows:
        rate = getattr(status.rates, name)
        shown = f"{rate:,.0f}" if name == "points" else f"{rate:.1f}"
        table.add_row(name, shown, f"{counts.accepted:,}", f"{sum(counts.rejected.values()):,}", waiting)
    table.add_row("refused", "", "", f"{sum(status.refused.values()):,}", "")
    return table


def _resources(status: MapStatus) -> Table:
    lag, tiles, log = status.lag_s, status.tiles, status.log
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="dim")
    table.add_column()
    known = lag.p50 is not None and lag.p99 is not None
    shown = f"{(lag.p50 or 0) * 1e3:.1f} ms, p99 {(lag.p99 or 0) * 1e3:.1f} ms" if known else "no clouds in 10 s"
    table.add_row("lag", shown)
    table.add_row("memory", _bytes(status.memory_bytes))
    extent = ""
    if status.extent is not None:
        xmin, ymin, xmax, ymax = status.extent
        extent = f", {xmax - xmin:,.0f} x {ymax - ymin:,.0f} m"
    forgotten = f", {status.forgotten:,} forgotten" if status.forgotten else ""
    table.add_row("tiles", f"{tiles.resident:,} in memory, {tiles.spilled:,} on disk{forgotten}{extent}")
    fault = "" if log.ok else ", NOT WRITABLE"
    name = printable(Path(log.file).name) if log.file else "none"
    table.add_row("log", Text(f"{_bytes(log.bytes)} in {name}{fault}", "" if log.ok else "bold red"))
    if growth := growth_text(log.bytes_per_hour, log.hours_to_full_disk, log.keep):
        table.add_row("", growth)
    return table


def _rejected(status: MapStatus) -> Table | None:
    kinds: tuple[tuple[str, type[Reason], Mapping[Any, int]], ...] = (
        ("cloud", CloudReason, status.clouds.rejected),
        ("point", PointReason, status.points.rejected),
        ("pose", PoseReason, status.poses.rejected),
        ("refused", Refusal, status.refused),
    )
    rows = [(kind, of, str(reason), n) for kind, of, counts in kinds for reason, n in counts.items() if n]
    if not rows:
        return None
    table = _table("rejected", "count", left=("reason", "meaning"))
    for kind, of, reason, n in rows:
        table.add_row(kind, f"{n:,}", reason, MEANING[of].get(reason, ""))
    return table


def _robots(status: MapStatus, robots: list[Row]) -> Table:
    table = _table("robot", "clouds/s", "points/s", "integrated", "rejected", "gaps", "jumps")
    known = {row.name: row for row in robots}
    for name in sorted({*known, *status.gaps, *status.jumps}):
        row = known.get(name, Row(name, 0.0, 0.0, 0, {}))
        rejected = ", ".join(f"{reason} {n:,}" for reason, n in row.rejected.items()) or "0"
        counts = (f"{n:,}" for n in (status.gaps.get(name, 0), status.jumps.get(name, 0)))
        table.add_row(
            Text(printable(name)),
            f"{row.clouds_per_s:.1f}",
            f"{row.points_per_s:,.0f}",
            f"{row.integrated:,}",
            rejected,
            *counts,
        )
    return table


def _bytes(number: int) -> str:
    return f"{number / 2**30:.2f} GiB" if number >= 1 << 30 else f"{number / 2**20:.1f} MiB"


def _duration(seconds: float) -> str:
    hours, rest = divmod(int(seconds), 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}"
