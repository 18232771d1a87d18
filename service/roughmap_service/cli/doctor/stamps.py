"""Judges the stamps of one stream of messages: unset, frozen, wild, late, or moved by a step of the clock."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from roughmap_service.cli.doctor.findings import Finding
from roughmap_service.cli.doctor.heard import Heard
from roughmap_service.run.odometry_clock import FROZEN
from roughmap_service.run.settings import NS

NEAR_NS = NS
"""A stamp that differs by more from what the arrivals let expect is wild, or the clock was set."""

RETURNS = 3
"""Messages after which the stamps must be back, or the clock itself was set."""

LIVE_NS = 60 * NS
"""Stamps this near to this machine's clock are not those of a recording."""

SOME_LATE = 3
"""Late messages that make a habit."""


@dataclass
class Course:
    """How the stamps of a stream went.

    Attributes:
        unset: messages with stamp 0.
        repeated: messages with the stamp of the one before; ``longest``: most in a row with one stamp.
        wild: by how many ns the stamps of single messages were off the others.
        late: messages older than the one before, while others go on.
        steps: by how many ns the clock was set, for each time.
        rows: indices of messages with rising stamps of one clock.
    """

    unset: int = 0
    repeated: int = 0
    longest: int = 1
    wild: list[int] = field(default_factory=list)
    late: int = 0
    steps: list[int] = field(default_factory=list)
    rows: list[list[int]] = field(default_factory=list)

    @property
    def is_frozen(self) -> bool:
        """Whether the stamps stand still."""
        return self.longest >= FROZEN or (self.longest > 2 and len(self.rows) == 1 and len(self.rows[0]) == 1)


def course(messages: Sequence[Heard]) -> Course:
    """Follow the stamps of messages in the order of arrival."""
    found = Course()
    kept = [at for at, message in enumerate(messages) if message.stamp_ns]
    found.unset = len(messages) - len(kept)
    if not kept:
        return found
    row, same, last = [kept[0]], 1, messages[kept[0]]
    place = 1
    while place < len(kept):
        at = kept[place]
        message = messages[at]
        step = message.stamp_ns - last.stamp_ns
        expected = message.arrival_ns - last.arrival_ns
        place += 1
        if step == 0:
            same += 1
            found.repeated += 1
            found.longest = max(found.longest, same)
            continue
        same = 1
        if 0 < step <= expected + NEAR_NS:
            row.append(at)
        elif (back := _returns(messages, kept, place, last, message)) is not None:
            skipped = [messages[kept[k]] for k in range(place - 1, back)]
            for one in skipped:
                off = one.stamp_ns - last.stamp_ns - (one.arrival_ns - last.arrival_ns)
                if abs(off) > NEAR_NS:
                    found.wild.append(off)
                else:
                    found.late += 1
            place = back
            continue  # the last good one stays the last
        elif place + RETURNS > len(kept):
            break  # too few messages follow to tell what it is
        elif len(row) == 1 and not found.rows and step < 0:
            row = [at]  # the very first was off, or the clock was set: there is nothing to tell it by
        else:
            found.steps.append(step - max(expected, 0))
            found.rows.append(row)
            row = [at]
        last = message
    found.rows.append(row)
    return found


def _returns(messages: Sequence[Heard], kept: Sequence[int], place: int, last: Heard, odd: Heard) -> int | None:
    """Return the place of the next message that goes on where the last good one was; None if none of the next does.

    A clock that was set goes on from the odd message: what follows is nearer to that one.
    """
    for ahead in range(place, min(place + RETURNS, len(kept))):
        message = messages[kept[ahead]]
        expected = message.arrival_ns - last.arrival_ns
        goes_on = 0 < message.stamp_ns - last.stamp_ns <= expected + NEAR_NS
        from_odd = message.stamp_ns - odd.stamp_ns - (message.arrival_ns - odd.arrival_ns)
        if goes_on and abs(from_odd) > abs(message.stamp_ns - last.stamp_ns - expected):
            return ahead
    return None


def clean(messages: Sequence[Heard], found: Course) -> list[Heard]:
    """Return the messages with rising stamps alone."""
    return [messages[at] for row in found.rows for at in row]


def judge_stamps(area: str, what: str, messages: Sequence[Heard], *, poses: bool) -> list[Finding]:
    """Return what is wrong with the stamps of clouds or poses; ``what`` names them, in the plural."""
    found, number = course(messages), len(messages)
    findings = []
    if found.unset:
        text = f"{found.unset} of {number} {what} have no stamp (0): the service refuses them (unset_stamp)"
        remedy = "let the publisher fill in header.stamp with the time of the measurement"
        findings.append(Finding(area, "wrong", text, remedy))
    if found.is_frozen:
        text = f"{what} have one stamp again and again: up to {found.longest} in a row"
        remedy = "let the publisher stamp each message with the time of its own measurement"
        findings.append(Finding(area, "wrong", text, remedy))
    elif found.repeated and poses:
        text = f"{found.repeated} of {number} {what} have the stamp of the one before; only the first one counts"
        findings.append(Finding(area, "note", text, "look for a second publisher of the same odometry"))
    if found.wild:
        worst = max(found.wild, key=abs)
        text = (
            f"{len(found.wild)} of {number} {what} have wild stamps, up to {_seconds(worst)} "
            f"{'ahead of' if worst > 0 else 'behind'} the others"
        )
        findings.append(Finding(area, "wrong", text, "look for the fault in the driver: these messages are lost"))
    if found.late:
        findings.append(_late(area, what, found, number, poses=poses))
    if found.steps:
        findings.append(_step(area, what, found.steps[0], len(found.steps), live=_live(messages)))
    return findings


def _late(area: str, what: str, found: Course, number: int, *, poses: bool) -> Finding:
    text = f"{found.late} of {number} {what} are older than the one before"
    if not poses:
        return Finding(area, "note", text, "each is placed by its own stamp")
    verdict: Literal["note", "wrong"] = "wrong" if found.late >= SOME_LATE else "note"
    return Finding(area, verdict, text, "look for a second publisher of the odometry, or one that does not keep order")


def _step(area: str, what: str, step: int, number: int, *, live: bool) -> Finding:
    times = f", {number} times" if number > 1 else ""
    if step < 0:
        text = f"stamps of {what} went back by {_seconds(step)} at once{times}"
        return Finding(
            area, "wrong", text, "let the clock be set by slewing (chrony); a recording that starts over does so too"
        )
    text = f"stamps of {what} leapt ahead by {_seconds(step)} at once{times}"
    remedy = "let the clock be set by slewing (chrony)" if live else "harmless if it is a gap in a recording"
    return Finding(area, "wrong" if live else "note", text, remedy)


def _live(messages: Sequence[Heard]) -> bool:
    off = [message.arrival_ns - message.stamp_ns for message in messages if message.stamp_ns]
    return bool(off) and min(abs(int(np.max(off))), abs(int(np.min(off)))) < LIVE_NS


def _seconds(ns: int) -> str:
    return f"{abs(ns) / NS:,.2f} s"
