"""What is odd about a robot's poses though they are taken: stamps in bursts, positions that jitter.

Doctor judges what it heard by these, and the service what it keeps. They decide nothing.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from roughmap_service.run.leaps import motion_before
from roughmap_service.run.pose_algebra import distance
from roughmap_service.run.poses import Pose
from roughmap_service.run.settings import NS

BURST = 0.2
"""A pose that follows so soon belongs to a burst: as a part of the mean time between two."""

MOSTLY = 0.4
"""Part of the poses that must be in bursts."""

PAIR, PAUSE = 2.5, 0.1
"""Two sources that take turns look like bursts of two. They are none unless more poses come together than that, or none
comes for so many seconds."""

FEWEST = 8
"""Steps between poses to judge by."""

RESTLESS = 5.0
"""m/s between neighbouring poses beyond the robot's own motion that are noise, and too much."""

LATER_NS = NS
"""A transform that is stamped so much later than all poses was stamped by another clock, or is static."""

BURST_REMEDY = (
    "stamp each pose when it is measured, not when it arrives; while it is so, scans are placed by wrong times"
)
JITTER_REMEDY = "publish a filter's output instead of single measurements, or less often"


class Bursts(NamedTuple):
    """About ``number`` poses are stamped ``apart`` s after each other, then none for ``pause`` s."""

    number: float
    apart: float
    pause: float

    def __str__(self) -> str:
        apart = f"{self.apart * 1e3:.1f} ms apart" if self.apart >= 1e-4 else "at nearly the same time"
        return f"odometry is stamped in bursts: about {self.number:.0f} poses {apart}, then none for {self.pause:.2f} s"


class Jitter(NamedTuple):
    """From pose to pose ``metres`` beside the robot's motion, at ``restless`` m/s; it moves at ``speed`` m/s."""

    metres: float
    restless: float
    speed: float

    def __str__(self) -> str:
        return (
            f"jitters by {self.metres * 100:.1f} cm from pose to pose: it seems to move at {self.restless:.0f} m/s, "
            f"over longer times at {self.speed:.1f} m/s"
        )


def later_transform(frame_id: str, ahead_ns: int) -> str | None:
    """Return what is odd about a frame's transforms that are all so much later than its poses; None if nothing is."""
    if ahead_ns <= LATER_NS:
        return None
    later = f"{ahead_ns / NS:,.1f} s later than the poses"
    return f"the transform to {frame_id!r} is stamped {later}: it holds as a static one"


def find_bursts(rows: Sequence[Sequence[int]]) -> Bursts | None:
    """Return whether rows of rising stamps (ns) come in bursts: when poses arrived, not when they were measured."""
    steps = np.array([b - a for row in rows for a, b in pairwise(row)], np.float64) * 1e-9
    if len(steps) < FEWEST:
        return None
    short = steps < BURST * steps.mean()
    if short.mean() < MOSTLY:
        return None
    found = Bursts(1 / (1 - short.mean()), float(np.median(steps[short])), float(np.median(steps[~short])))
    return found if found.number >= PAIR or found.pause >= PAUSE else None


def find_jitter(rows: Sequence[Sequence[Pose]]) -> Jitter | None:
    """Return by how much poses of one frame, in rows of rising stamps, are off the robot's motion; None if by little.

    Poses that leapt are left out.
    """
    speeds: list[float] = []
    off: list[tuple[float, float]] = []
    for row in rows:
        for at, pose in enumerate(row):
            if pose.leapt or (before := motion_before(row, at)) is None:
                continue
            speeds.append(distance((0.0, 0.0, 0.0), before.velocity))
            seconds = (pose.stamp_ns - row[at - 1].stamp_ns) * 1e-9
            last = row[at - 1].position
            led = [p + v * seconds for p, v in zip(last, before.velocity, strict=True)]
            moved = distance(led, pose.position)
            off.append((moved, moved / seconds))
    if not off:
        return None
    metres, restless = (float(np.median([one[k] for one in off])) for k in (0, 1))
    return Jitter(metres, restless, float(np.median(speeds))) if restless > RESTLESS else None
