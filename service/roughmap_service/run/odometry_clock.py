"""Which of a robot's odometry can be believed, by the order of arrival and by stamps.

A clock that leaps, forward or back, takes three messages to be believed; one wild stamp costs itself alone.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from itertools import pairwise
from typing import Any

from roughmap_schemas import PoseReason
from roughmap_service.run.poses import Pose

BELIEVED = 3
"""Messages in a row with rising stamps after which a leap of the stamps is a leap of the clock."""

BELIEVED_LATER = 10
"""The same where the steps between them are longer than `input.max_pose_gap`, and for a clock that goes back where two
sources' stamps are mixed."""

MAX_HELD = 10
"""Messages that are held; as many as any rule looks at."""

FROZEN = 10
"""Messages in a row with one stamp, after which the clock counts as frozen."""

BREAKS = 3
"""Breaks within the pose history after which the robot has two sources."""

GAPS = 8
"""Last steps between stamps that are kept."""

NEXT = 3
"""How many times the longest but one of them the next step may be; a stamp further ahead is held. The longest may have
lost messages within it."""

BACK_FENCE_NS = 1_000_000_000
BREAK_FENCE_NS = 500_000_000
"""How far the poses must have gone on after a clock went back, or a break, before a sensor that never fell back counts
as having the new time. Until then its clouds may have been made before it."""


MIXED_STEP, MIXED_MOST = 3, 30
"""A low stamp adds three, a message taken without one takes one off; from 30 on, the robot has two sources until 0."""


class Verdict(Enum):
    """What becomes of an odometry."""

    TAKE = auto()
    REPEAT = auto()
    """It has the newest stamp again."""
    HOLD = auto()
    FORWARD = auto()
    """The clock leapt forward: it is taken with those that were held."""
    BACK = auto()
    """The clock went back: the poses begin anew with those that were held and this one."""
    BREAK = auto()
    """The clock went back by less than it took to notice: the poses begin anew with this one."""

    @property
    def begins_anew(self) -> bool:
        """Whether the poses so far are forgotten."""
        return self in (Verdict.BACK, Verdict.BREAK)


@dataclass(frozen=True, slots=True)
class Held:
    """An odometry that is not believed yet: its pose, or why it gives none."""

    stamp_ns: int
    input: int
    pose: Pose | PoseReason


@dataclass
class OdometryClock:
    """The state of one robot's odometry stamps.

    Attributes:
        newest_ns: the newest stamp taken, H; -1 before the first.
        held: those since the last one taken that are not believed yet.
        doubted: input number of the first message since the last one taken that was held; 0 if there is none.
        repeats: messages in a row with the newest stamp again; ``repeated``: input number of the first of them.
        taken: number of messages taken since the poses began anew; ``last_input``: input number of the last one.
        begun: input number of the first message of the present clock.
        fence_ns: stamp that the poses must reach before sensors that never fell back are of the present clock.
        gaps: the last steps between stamps taken, in ns.
        breaks: stamps of the last breaks.
        mixed: how much the last messages look like those of two sources, 0 to `MIXED_MOST`.
        two_sources: whether the robot's odometry mixes two sources.
        anew_from: after a reset of the map, the next input number: whatever stamp comes next is believed. Else 0.
    """

    newest_ns: int = -1
    held: list[Held] = field(default_factory=list)
    doubted: int = 0
    repeats: int = 0
    repeated: int = 0
    taken: int = 0
    last_input: int = 0
    begun: int = 0
    fence_ns: int = 0
    gaps: deque[int] = field(default_factory=lambda: deque(maxlen=GAPS))
    breaks: deque[int] = field(default_factory=lambda: deque(maxlen=BREAKS))
    mixed: int = 0
    two_sources: bool = False
    anew_from: int = 0

    def judge(self, stamp_ns: int, max_gap_ns: float, history_ns: int) -> Verdict:
        """Return what becomes of a message of this stamp; nothing changes."""
        newest, held = self.newest_ns, self.held
        if newest < 0:
            return Verdict.TAKE
        if stamp_ns == newest:
            return Verdict.BACK if self.anew_from else Verdict.REPEAT
        next_ns = self._next_ns(max_gap_ns, history_ns)
        if newest < stamp_ns <= newest + next_ns:
            # A small step back is a row that went on from below; a wild stamp is not.
            low = [one.stamp_ns for one in held if one.stamp_ns <= newest]
            went_on = bool(low) and stamp_ns - low[-1] <= next_ns
            return Verdict.BREAK if went_on and not self.two_sources else Verdict.TAKE
        if self.anew_from:
            return Verdict.FORWARD if stamp_ns > newest else Verdict.BACK
        row = [one.stamp_ns for one in held] + [stamp_ns]
        three, ten = row[-BELIEVED:], row[-BELIEVED_LATER:]
        for some, enough, step_ns in (
            (three, BELIEVED, min(max_gap_ns, history_ns)),
            (ten, BELIEVED_LATER, history_ns),
        ):
            if len(some) == enough and _rises(some, step_ns):
                if some[0] > newest:
                    return Verdict.FORWARD
                if some[-1] <= newest and not self.two_sources:
                    return Verdict.BACK
        if self.two_sources and len(ten) == BELIEVED_LATER and max(ten) <= newest and max(ten) > ten[0]:
            return Verdict.BACK
        return Verdict.HOLD

    def _next_ns(self, max_gap_ns: float, history_ns: int) -> float:
        """Return how far ahead of the newest the next stamp may be.

        A usual step is no leap, even if it is too long to place clouds in it.
        """
        gaps = sorted(self.gaps)
        if not gaps:
            return min(max_gap_ns, history_ns)
        if len(gaps) == 1:
            return min(max(max_gap_ns, 1.5 * gaps[0]), history_ns)
        return min(max(min(max_gap_ns, NEXT * gaps[-2]), 1.5 * gaps[-2]), history_ns)

    def row_of(self, stamp_ns: int, held: list[Held], max_gap_ns: float, history_ns: int) -> list[Held]:
        """Return the last of those held that a believed message of this stamp belongs to."""
        if self.two_sources and stamp_ns <= self.newest_ns:
            return held[1 - BELIEVED_LATER :]
        row: list[Held] = []
        for step_ns in (min(max_gap_ns, history_ns), history_ns):
            after, row = stamp_ns, []
            for one in reversed(held):
                if not after - step_ns <= one.stamp_ns < after:
                    break
                row.insert(0, one)
                after = one.stamp_ns
            if len(row) >= BELIEVED - 1:
                break
        return row

    def doubts(self, number: int, last_ns: int) -> bool:
        """Return whether a cloud with this input number, whose last point is of this time, must not be placed yet.

        While a message is held, the clock may have leapt for all that came after it. While stamps repeat, only for what
        is not older than them.
        """
        if self.doubted and self.doubted < number:
            return True
        return bool(self.repeated) and self.repeated < number and last_ns >= self.newest_ns

    def count_repeat(self, number: int) -> bool:
        """Count a message with the newest stamp again. Return whether the clock counts as frozen."""
        self.repeated = self.repeated or number
        self.repeats += 1
        return self.repeats >= FROZEN

    def hold(self, one: Held) -> Held | None:
        """Hold a message. Return the one that is given up for lack of room."""
        self.doubted = self.doubted or one.input
        self.held.append(one)
        return self.held.pop(0) if len(self.held) > MAX_HELD else None

    def release(self) -> list[Held]:
        """Hold nothing any more; return what was held."""
        held, self.held = self.held, []
        self.doubted = 0
        return held

    def take(self, stamp_ns: int, number: int) -> None:
        """Count a message as taken."""
        if 0 <= self.newest_ns < stamp_ns:
            self.gaps.append(stamp_ns - self.newest_ns)
        self.newest_ns = max(self.newest_ns, stamp_ns)
        self.taken += 1
        self.last_input = max(self.last_input, number)
        self.anew_from = 0
        self.repeats = self.repeated = 0

    def begin(self, number: int, fence_ns: int) -> None:
        """Begin anew with the message of this number."""
        self.newest_ns, self.taken = -1, 0
        self.begun, self.fence_ns = number, fence_ns

    def count_break(self, stamp_ns: int, history_ns: int) -> None:
        """Count a break. Several show that the robot has two sources."""
        self.breaks.append(stamp_ns)
        row = self.breaks
        if not self.two_sources and len(row) == BREAKS and abs(row[-1] - row[0]) <= history_ns:
            self.two_sources, self.mixed = True, MIXED_MOST

    def count_mixed(self, *, low: bool) -> None:
        """Count a message taken, and whether a ``low`` one came before it. Enough of them show two sources.

        One of them may be so late that its stamps never go on from the other's. Where nothing low comes for a while,
        there is one source.
        """
        self.mixed = min(self.mixed + MIXED_STEP, MIXED_MOST) if low else max(self.mixed - 1, 0)
        self.two_sources = self.mixed == MIXED_MOST or (self.two_sources and self.mixed > 0)

    def to_state(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        held = [[h.stamp_ns, h.input, h.pose.to_state() if isinstance(h.pose, Pose) else h.pose] for h in self.held]
        return {**vars(self), "held": held, "gaps": list(self.gaps), "breaks": list(self.breaks)}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what `to_state` returned."""
        held = [
            Held(s, i, PoseReason(pose) if isinstance(pose, str) else Pose.of_state(pose))
            for s, i, pose in state["held"]
        ]
        for name, value in state.items():
            setattr(self, name, value)
        self.held, self.gaps, self.breaks = held, deque(state["gaps"], GAPS), deque(state["breaks"], BREAKS)


def _rises(stamps: Sequence[int], step_ns: float) -> bool:
    return all(a < b <= a + step_ns for a, b in pairwise(stamps))
