"""Judges clocks by arrivals: a sensor's against its robot's odometry, and both against this machine's."""

from collections.abc import Sequence

import numpy as np

from roughmap_service.cli.doctor.findings import Finding, Verdict, table
from roughmap_service.cli.doctor.heard import Heard
from roughmap_service.run.sensor_clock import LIMIT_NS, NOTICE_NS
from roughmap_service.run.settings import NS

CLOCK_S = 1.0
"""Stamps further than this from those of another clock, in seconds, are no matter of latency."""

NOTICE_S = 0.3
"""A difference in seconds that is worth a look: the latencies of scanners and localisations are below."""

WINDOW_NS = NS
"""Time over which the quickest message counts: the others waited on their way."""

LEAST = 3
"""Messages of each stream in a window that is compared."""

RATIO = 0.1
"""How far stamps may advance quicker or slower than arrivals: a recording may be played at another speed."""

TAI_S, GPS_S, HOUR_S = 37.0, 18.0, 3600.0
"""Seconds by which other time scales are ahead of UTC (until the next leap second), and a step of time zones."""

SCALE_S = 0.4
"""How far a difference may be from one of these, in seconds, to be taken for it."""


def offset_s(clouds: Sequence[Heard], poses: Sequence[Heard]) -> float | None:
    """Return by how many seconds the clouds' clock is ahead of the poses', by arrivals; None if that can't be told.

    It holds up to the difference of the two latencies.
    """
    if not clouds or not poses:
        return None
    ahead = [o - c for c, o in _window_latencies(clouds, poses, least=1)]
    if ahead and _in_real_time(clouds) and _in_real_time(poses):
        return float(np.median(ahead)) / NS
    arrivals = np.array([pose.arrival_ns for pose in poses], np.float64)
    stamps = np.array([pose.stamp_ns - poses[0].stamp_ns for pose in poses], np.float64)
    at = np.array([cloud.arrival_ns for cloud in clouds], np.float64)
    heard = (at >= arrivals[0]) & (at <= arrivals[-1])
    if not heard.any():
        return None
    relative = np.array([cloud.stamp_ns - poses[0].stamp_ns for cloud in clouds], np.float64)
    return float(np.median((relative - np.interp(at, arrivals, stamps))[heard])) / NS


def moved_s(clouds: Sequence[Heard], poses: Sequence[Heard]) -> float:
    """Return by how many seconds the clouds' clock moved ahead of the poses' meanwhile; 0 if that can't be told."""
    if not (_in_real_time(clouds) and _in_real_time(poses)):
        return 0.0
    ahead = np.array([o - c for c, o in _window_latencies(clouds, poses, least=LEAST)], np.float64)
    moves = [float(np.median(ahead[cut:]) - np.median(ahead[:cut])) for cut in range(1, len(ahead))]
    return max(moves, key=abs, default=0.0) / NS


def judge_sensor_clock(
    robot: str,
    frame: str,
    clouds: Sequence[Heard],
    poses: Sequence[Heard],
    *,
    table_names: tuple[str, ...],
    time_offset: float,
    stepped: bool,
) -> list[Finding]:
    """Compare a sensor's clouds with its robot's odometry; both have rising stamps, the clouds' with ``time_offset``.

    ``table_names`` is the sensor's table, for the remedy. ``stepped``: a step in one of them is already told.
    """
    offset = offset_s(clouds, poses)
    if offset is None:
        return []
    if abs(offset) > CLOCK_S:
        right = _round(-offset)
        side = "ahead of" if offset > 0 else "behind"
        text = f"clouds in {frame!r} are stamped {_figure(abs(right))} s {side} the odometry: their clocks differ"
        if scale := _scale(offset):
            text += f" ({scale})"
        exact = "" if scale else " (measured by arrival, to some 0.1 s)"
        remedy = f"synchronise scanner and localisation (PTP, NTP), or correct the clouds' stamps{exact}:"
        settings = table(table_names, {"time_offset": round(time_offset + right, 3)})
        return [Finding(robot, "wrong", text, remedy, settings)]
    moved = moved_s(clouds, poses)
    if abs(moved) * NS > NOTICE_NS and not stepped:
        verdict: Verdict = "wrong" if moved * NS > LIMIT_NS else "note"
        text = (
            f"clouds in {frame!r} came {abs(moved):.2f} s {'sooner' if moved > 0 else 'later'} after their stamps than "
        )
        text += "before, compared with the odometry: " + ("one clock moved alone" if moved > 0 else "a longer latency")
        return [Finding(robot, verdict, text, "synchronise scanner and localisation (PTP, NTP), by slewing")]
    if abs(offset) > NOTICE_S:
        side = "sooner" if offset > 0 else "later"
        text = f"clouds in {frame!r} come {abs(offset):.2f} s {side} than poses of the same stamp"
        remedy = "that may be latency; if it is the clocks, correct it: ground is placed where the robot was then"
        return [Finding(robot, "note", text, remedy)]
    return []


def judge_machine_clock(robot: str, messages: Sequence[Heard]) -> list[Finding]:
    """Compare a robot's stamps with this machine's clock."""
    if not messages:
        return []
    behind = float(np.median([message.arrival_ns - message.stamp_ns for message in messages])) / NS
    if abs(behind) <= CLOCK_S:
        return []
    text = f"stamps are {abs(behind):,.1f} s {'behind' if behind > 0 else 'ahead of'} this machine's clock"
    return [Finding(robot, "note", text, "harmless for the map; if this is not a recording, synchronise the clocks")]


def _window_latencies(clouds: Sequence[Heard], poses: Sequence[Heard], *, least: int) -> list[tuple[int, int]]:
    """Return the least latencies of both in ns, for each window in which both have enough messages."""
    start = min(clouds[0].arrival_ns, poses[0].arrival_ns)
    a, b = (_latencies(messages, start) for messages in (clouds, poses))
    common = [window for window in sorted(a) if len(a[window]) >= least and len(b.get(window, ())) >= least]
    return [(min(a[window]), min(b[window])) for window in common]


def _latencies(messages: Sequence[Heard], start: int) -> dict[int, list[int]]:
    windows: dict[int, list[int]] = {}
    for arrival, stamp in messages:
        windows.setdefault((arrival - start) // WINDOW_NS, []).append(arrival - stamp)
    return windows


def _in_real_time(messages: Sequence[Heard]) -> bool:
    """Return whether the stamps advance as the arrivals do."""
    took = messages[-1].arrival_ns - messages[0].arrival_ns
    # Over a short time, latencies matter more than the speed.
    return abs(messages[-1].stamp_ns - messages[0].stamp_ns - took) <= RATIO * took + NS / 2


def _scale(offset: float) -> str:
    size = abs(offset)
    if abs(size - TAI_S) < SCALE_S:
        return "37 s: TAI instead of UTC"
    if abs(size - GPS_S) < SCALE_S:
        return "18 s: GPS time instead of UTC"
    if size > HOUR_S / 2 and abs(size / HOUR_S - round(size / HOUR_S)) * HOUR_S < SCALE_S:
        return "whole hours: a time zone"
    return ""


def _round(offset: float) -> float:
    """Return a difference as exactly as it is known: that of a time scale is known, others to some 10 ms."""
    return float(round(offset)) if _scale(offset) else round(offset, 2)


def _figure(size: float) -> str:
    return f"{size:,.1f}" if size >= 10 else f"{size:.2f}"
