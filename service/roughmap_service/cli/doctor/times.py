"""Judges the times of a sensor's points: whether they have any, and in which form."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from roughmap_schemas import NO_TIMES, TimeField, TimeForm
from roughmap_schemas.point_times import relative_ns
from roughmap_schemas.robot_sections import SensorConfig
from roughmap_service.cli.doctor.findings import Finding, table
from roughmap_service.run.point_times import FIRING, NAMES, SHARES, SHORTEST_S, Ambiguous, find_form
from roughmap_service.run.settings import NS

FEW, MOST = 0.01, 0.5
"""Parts of the points without a valid time: from the first one on it is told, from the second on it is wrong."""

LONG = 3.0
"""Times from one cloud to the next that a sweep can't last: scans overlap a little, and stamps jitter."""

ORIGINS = {"start": "from the sweep's start", "end": "to the sweep's end", "absolute": "since 1970"}


class TimeSample(NamedTuple):
    """A cloud's stamp, those of its fields that may hold its points' times, and the names of the others."""

    stamp_ns: int
    fields: tuple[TimeField, ...]
    others: tuple[str, ...]


@dataclass(frozen=True)
class Times:
    """The form of a sensor's times, and what comes of it.

    ``first_ns``, ``last_ns``: when the first and the last point of a usual cloud were measured, after the stamp.
    ``invalid``: the part of the points without a valid time.
    """

    form: TimeForm | Ambiguous
    first_ns: int = 0
    last_ns: int = 0
    invalid: float = 0.0


def read_times(samples: Sequence[TimeSample], sensor: SensorConfig | None) -> Times | None:
    """Find the form of the times in a sensor's first clouds, as the service does; None if the clouds are too small."""
    fields = [(sample.stamp_ns, sample.fields) for sample in samples]
    said = (sensor.time_field, sensor.time_unit, sensor.time_origin) if sensor is not None else ("auto", "auto", "auto")
    form = None
    for number in range(1, len(fields) + 1):  # one cloud may be enough; of several, stamps must fit too
        form = find_form(fields[:number], *said, last=number == len(fields))
        if form is not None:
            break
    if form is None:
        return None
    if isinstance(form, Ambiguous) or not form.field:
        return Times(form)
    extents, shares = [], []
    for sample in samples:
        values = next((field.values for field in sample.fields if field.name == form.field), None)
        if values is None or not len(values):
            continue
        times, first, last = relative_ns(values, sample.stamp_ns, form)
        good = times[(times >= first) & (times <= last)]
        shares.append(1.0 - len(good) / len(times))
        if len(good):
            extents.append((int(good.min()), int(good.max())))
    if not shares:
        return Times(form, invalid=1.0)
    if not extents or np.mean(shares) >= MOST:
        return Times(form, invalid=float(np.mean(shares)))
    first_ns, last_ns = (round(float(np.median([extent[k] for extent in extents]))) for k in (0, 1))
    return Times(form, first_ns, last_ns, float(np.mean(shares)))


def judge_times(
    robot: str,
    frame: str,
    samples: Sequence[TimeSample],
    found: Times,
    sensor: SensorConfig | None,
    table_names: tuple[str, ...],
) -> list[Finding]:
    """Judge what ``read_times`` found; ``table_names`` is the sensor's table, for the remedy."""
    form = found.form
    if isinstance(form, Ambiguous):
        text = f"it is unclear how the times of points in {frame!r} are meant: {form.seen}; its clouds end as time_form"
        how = "say it by time_field, time_unit and time_origin"
        if SHARES in form.seen:
            how = "let the driver send times in s, ms, us or ns"
        remedy = f"{how}; until then, map without these times:"
        return [Finding(robot, "wrong", text, remedy, table(table_names, {"time_field": "none"}))]
    if not form.field:
        return _without(robot, frame, samples, sensor)
    dtype = next((f.values.dtype.name for sample in samples for f in sample.fields if f.name == form.field), "missing")
    span = (found.last_ns - found.first_ns) / NS
    shown = f"{form.field} ({dtype}) in {form.unit} {ORIGINS[form.origin]}"
    points = max((len(field.values) for sample in samples for field in sample.fields), default=0)
    if found.invalid >= MOST or (span < SHORTEST_S and points > FIRING):
        text = f"times of points in {frame!r} are read as {shown}, which they are not: "
        text += f"{100 * found.invalid:.0f} % are no valid time" if found.invalid >= MOST else f"they span {span:.6f} s"
        right = find_form([(sample.stamp_ns, sample.fields) for sample in samples], last=True)
        values = {"time_field": "none"}
        if isinstance(right, TimeForm) and right not in {NO_TIMES, form}:
            values = {"time_field": right.field, "time_unit": right.unit, "time_origin": right.origin}
        return [Finding(robot, "wrong", text, "correct what the sensor's table says:", table(table_names, values))]
    text = f"points in {frame!r} have times: {shown}, over {span:.4f} s"
    steps = [b.stamp_ns - a.stamp_ns for a, b in pairwise(samples)]
    if steps and span > LONG * float(np.median(steps)) / NS > 0.0:
        remedy = "check the field and its unit; until it is right, map without these times:"
        text += f", but clouds are {np.median(steps) / NS:.3g} s apart"
        return [Finding(robot, "wrong", text, remedy, table(table_names, {"time_field": "none"}))]
    findings = [Finding(robot, "ok", text)]
    if found.invalid >= FEW:
        text = f"{100 * found.invalid:.0f} % of the points in {frame!r} have no valid time and are rejected (time)"
        findings.append(Finding(robot, "note", text, "look for the fault in the driver: a number that overflowed?"))
    return findings


def _without(robot: str, frame: str, samples: Sequence[TimeSample], sensor: SensorConfig | None) -> list[Finding]:
    """Judge clouds whose points have no times."""
    if (sensor is not None and sensor.time_field == "none") or not samples:
        return []
    equal = sorted({field.name for sample in samples for field in sample.fields if field.name in NAMES})
    others = sorted({name for sample in samples for name in sample.others})
    if equal:
        text = f"clouds in {frame!r} have no per-point times: {', '.join(equal)} is the same for all points"
    else:
        text = f"clouds in {frame!r} have no per-point times: none of the fields {', '.join(NAMES)}"
        text += f", but {', '.join(others[:8])}" if others else ""
    remedy = "let the driver send them, or name their field by time_field: motion during a sweep smears the ground"
    return [Finding(robot, "note", text, remedy)]
