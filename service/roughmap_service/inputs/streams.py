"""What became of each robot's and each sensor's messages lately: tells when they come to nothing, and why.

Live only: a replay decides by events, and nothing of this goes into the log. Times are of the monotonic clock.
"""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from roughmap_schemas import Config
from roughmap_schemas.reasons import PointReason, Refusal
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.losses import SILENT, Cause, Losses, Outcome, cloud_cause
from roughmap_service.inputs.recent import Recent
from roughmap_service.inputs.remedies import (
    ANY_CLOUDS,
    CLOUDS,
    MESSAGES,
    POSES,
    SERVICES_OWN,
    TRANSFORMS,
    Figures,
    Subject,
    in_one_line,
    lost_on_the_way,
    points_lost,
    sentence,
)

logger = logging.getLogger(__name__)

MAX_PROBLEMS: Final = 32
"""Problems that a status lists."""

MAX_SUBJECTS, MAX_STRANGERS = 1024, 64
"""Subjects that are watched; of them, those of which every message was refused: their names may be anything."""

MAX_NAME: Final = 256
"""Characters of a frame's name: as long as a configured one may be."""

MAX_REMARKS: Final = 8
"""Standing facts about one subject."""

STOPPED: Final = 1.0
"""Seconds without odometry after which it counts as stopped, and a cloud so far ahead says nothing about clocks."""

NOTED_POINTS: Final = {
    PointReason.DUPLICATE_RETURN: 0.0, PointReason.UNCERTAIN: 0.2, PointReason.TIME: 0.2, PointReason.NO_POSE: 0.2,
    PointReason.COVARIANCE: 0.2,
}  # fmt: skip
"""Reasons of points that are told of a mapped cloud, from which share of them on. The others depend on the place."""

RENEWED: Final = 30.0
"""Seconds after which the figures of a standing problem are taken anew."""

FindFigures = Callable[[], Figures]
"""Finds the figures of a loss; called only when a sentence is made of them."""

NO_POINTS: Final[Mapping[str, int]] = {}

RESTORED: Final = {
    POSES: "its poses are taken again", CLOUDS: "its clouds are mapped again", TRANSFORMS: "its transforms are taken",
    ANY_CLOUDS: "its clouds are taken again", MESSAGES: "its messages are taken again",
}  # fmt: skip


@dataclass
class _Stream:
    """One kind of messages of a subject. ``told``: the sentence of the present problem, made at ``told_at`` (s)."""

    losses: Losses = field(default_factory=Losses)
    told: str = ""
    told_at: float = 0.0


@dataclass
class _Watched:
    """A robot or a sensor: when it was heard last, its streams by kind, and standing facts about it by name.

    ``on_the_way``: messages lost on the way by kind; ``untold``: the kinds of which it is not told yet.
    """

    heard: float
    stranger: bool
    streams: dict[str, _Stream] = field(default_factory=dict)
    remarks: dict[str, str] = field(default_factory=dict)
    on_the_way: dict[str, int] = field(default_factory=dict)
    untold: set[str] = field(default_factory=set)


class Streams:
    """Watches what became of messages; any thread may call it. It never waits longer than for a log line.

    ``recent`` has what happened lately and is no problem as long as it does not go on.
    """

    def __init__(self, config: Config, clock: Callable[[], float] = time.monotonic) -> None:
        self._config = config
        self._clock = clock
        self._lock = threading.Lock()
        self._watched: dict[Subject, _Watched] = {}
        self._next_sweep = 0.0
        self._strangers = 0
        self.recent = Recent(clock)

    def cloud(
        self,
        robot: str,
        frame_id: str,
        outcome: str,
        accepted: int,
        rejected: Mapping[str, int],
        figures: FindFigures = Figures,
    ) -> None:
        """Count a decided cloud: its outcome, and the numbers of its points that were accepted and, by reason, not."""
        if outcome in SERVICES_OWN:
            return
        cause = cloud_cause(outcome, accepted, rejected)
        self._take(Subject(robot, frame_id[:MAX_NAME]), CLOUDS, cause, figures, accepted=accepted, rejected=rejected)
        self._take(Subject(robot), ANY_CLOUDS, None, known_only=True)
        if cause is None:
            self._points_lost(Subject(robot, frame_id[:MAX_NAME]), accepted, rejected)

    def pose(self, robot: str, reason: str | None, figures: FindFigures = Figures) -> None:
        """Count an odometry message whose fate is settled; ``reason`` is None if its pose was taken."""
        self._take(Subject(robot), POSES, None if reason is None else Cause("pose", str(reason)), figures)

    def transform(self, robot: str) -> None:
        """Count a transform that reached the log."""
        self._take(Subject(robot), TRANSFORMS, None, known_only=True)

    def gap(self, robot: str, kind: str, number: int) -> None:
        """Count messages of a kind that were lost on the way. Until something of the robot is taken, it is not told."""
        with self._lock:
            watched = self._find(Subject(robot), self._clock(), stranger=True)
            if watched is None:
                return
            watched.on_the_way[kind] = total = watched.on_the_way.get(kind, 0) + number
            if watched.stranger:
                watched.untold.add(kind)
                return
        _tell_gap(self.recent, robot, kind, total)

    def happened(self, subject: Subject, name: str, text: str) -> str | None:
        """List for a while what happened once to a subject. Return the sentence if it is to be logged."""
        return self.recent.add(subject, name, lambda: in_one_line(f"{subject}: {text}"))

    def refused(self, robot: str, what: str, reason: str, text: str) -> None:
        """Count a message that never reached the log.

        ``what`` is its kind, or its frame if it was a cloud that named one; ``text`` says what is wrong with it.
        """
        if reason in SERVICES_OWN:
            return
        cause, figures = Cause("refused", str(reason)), Figures(text)
        if reason in (Refusal.UNKNOWN_ROBOT, Refusal.BAD_KEY):  # whatever it sends
            what = MESSAGES
        elif reason == Refusal.UNKNOWN_SENSOR and what == ANY_CLOUDS:
            figures = Figures(text, "let its driver set frame_id")
        sensor = what not in (POSES, TRANSFORMS, ANY_CLOUDS, MESSAGES)
        subject = Subject(robot, what[:MAX_NAME]) if sensor else Subject(robot)
        self._take(subject, CLOUDS if sensor else what, cause, lambda: figures, stranger=True)

    def remark(self, subject: Subject, name: str, text: str | None) -> None:
        """State a fact about a subject that holds until it is called with None; told once per change.

        It is a problem while the subject sends.
        """
        sentence = None if text is None else in_one_line(f"{subject}: {text}")
        with self._lock:
            watched = self._find(subject, self._clock(), stranger=False)
            if watched is None or watched.remarks.get(name) == sentence:
                return
            if sentence is None:
                del watched.remarks[name]
            elif name in watched.remarks or len(watched.remarks) < MAX_REMARKS:
                watched.remarks[name] = sentence
            else:
                return
        if sentence is None:
            over = f"{subject}: {name}: no longer"
            note(logger, logging.INFO, "remark_ended", over, robot=subject.robot, reason=name, subject=str(subject))
        else:
            note(logger, logging.WARNING, "remark", sentence, robot=subject.robot, reason=name, subject=str(subject))

    def problems(self) -> dict[str, str]:
        """Return the sentence on each subject that has a problem, at most `MAX_PROBLEMS`, those of which every message
        was refused last; call it now and then: it also ends the problems of subjects that have gone silent."""
        now = self._clock()
        with self._lock:
            silent = self._end_silent(now)
            found: dict[str, str] = {}
            for subject, watched in sorted(self._watched.items(), key=lambda item: item[1].stranger):
                told = [stream.told for stream in watched.streams.values() if stream.told]
                if watched.remarks and now - watched.heard <= SILENT:
                    told += watched.remarks.values()
                if told:
                    rest = [text.removeprefix(f"{subject}: ") for text in told[1:]]
                    found[str(subject)] = "; ".join([told[0], *rest])
        for subject in silent:
            text = f"{subject}: it sends no more; its problem is no longer listed"
            note(logger, logging.INFO, "stream_silent", text, robot=subject.robot, subject=str(subject))
        return limited(found)

    def _take(
        self,
        subject: Subject,
        kind: str,
        cause: Cause | None,
        figures: FindFigures = Figures,
        *,
        accepted: int = 0,
        rejected: Mapping[str, int] = NO_POINTS,
        stranger: bool = False,
        known_only: bool = False,
    ) -> None:
        """Count what became of a message of one of a subject's streams, and tell if that is a change.

        ``stranger``: the message was refused; ``known_only``: a subject or stream that is not known stays so.
        """
        with self._lock:
            now = self._clock()
            watched = self._watched.get(subject) if known_only else self._find(subject, now, stranger=stranger)
            if watched is None or (known_only and kind not in watched.streams):
                return
            gaps = {} if watched.stranger else {of: watched.on_the_way[of] for of in watched.untold}
            watched.untold -= gaps.keys()
            stream = watched.streams.get(kind)
            if stream is None:
                stream = watched.streams[kind] = _Stream()
            losses, before = stream.losses, stream.losses.lost
            outcome = Outcome(now, cause, accepted, rejected)
            losses.add(outcome)
            lost, some = losses.lost, None
            if lost is None and cause is not None and not watched.stranger:
                say = partial(self._sentence, subject, kind, cause, losses, figures)
                some = self.recent.add(subject, f"{kind} {cause.kind} {cause.reason}", say)
            elif lost is not None:  # the problem says it
                self.recent.drop(subject, f"{kind} {lost.kind} {lost.reason}")
            changed = lost != before or (lost is not None and now - stream.told_at >= RENEWED and cause == lost)
            if changed:
                stream.told_at = now
                stream.told = "" if lost is None else self._sentence(subject, kind, lost, losses, figures)
        for of, total in gaps.items():
            _tell_gap(self.recent, subject.robot, of, total)
        if some is not None and cause is not None and cause.kind != "refused":  # each refusal has its line
            _note_some(subject, cause.reason, some)
        if not changed:
            return
        if lost is None:
            text = f"{subject}: {RESTORED[kind]}"
            note(logger, logging.INFO, "stream_restored", text, robot=subject.robot, subject=str(subject))
        elif lost != before:
            note(
                logger, logging.WARNING, "stream_lost", stream.told, robot=subject.robot, reason=lost.reason,
                subject=str(subject),
            )  # fmt: skip

    def _points_lost(self, subject: Subject, accepted: int, rejected: Mapping[str, int]) -> None:
        """Tell of points that are lost though their cloud is mapped, as far as they say that something is wrong."""
        number = accepted + sum(rejected.values())
        for reason, least in NOTED_POINTS.items():
            lost = rejected.get(reason, 0)
            if lost and lost >= least * number:
                say = partial(points_lost, self._config, subject, reason, lost, number)
                text = self.recent.add(subject, f"points {reason}", say)
                if text is not None:
                    _note_some(subject, reason, text)

    def _sentence(self, subject: Subject, kind: str, lost: Cause, losses: Losses, figures: FindFigures) -> str:
        found = figures() if losses.last[-1].cause == lost else Figures()  # of another loss they would mislead
        if lost == ("cloud", "no_pose") and not found.certain:
            found = self._without_poses(subject.robot, losses.last[-1].at) or found
        return sentence(self._config, subject, lost, losses.last, found, kind)

    def _without_poses(self, robot: str, now: float) -> Figures | None:
        """Return what is to be said of a robot that has no poses at all; None if it has some."""
        watched = self._watched.get(Subject(robot))
        poses = None if watched is None else watched.streams.get(POSES)
        if poses is None or not poses.losses.last:
            return Figures("no odometry has come from the robot")
        if poses.told:
            return Figures("none of the robot's poses is taken", f"see the line of robot {robot}")
        since = now - poses.losses.last[-1].at
        return Figures(f"its last odometry came {since:.0f} s ago") if since > STOPPED else None

    def _find(self, subject: Subject, now: float, *, stranger: bool) -> _Watched | None:
        """Return what is known of a subject that was heard now; None if there is no room for it."""
        watched = self._watched.get(subject)
        if watched is None:
            if self._is_full(stranger=stranger) and now >= self._next_sweep:
                self._next_sweep = now + 1.0
                self._forget(now)
            if self._is_full(stranger=stranger):
                return None
            watched = self._watched[subject] = _Watched(now, stranger)
            self._strangers += stranger
        watched.heard = now
        if watched.stranger and not stranger:
            watched.stranger = False
            self._strangers -= 1
        return watched

    def _is_full(self, *, stranger: bool) -> bool:
        return len(self._watched) >= MAX_SUBJECTS or (stranger and self._strangers >= MAX_STRANGERS)

    def _forget(self, now: float) -> None:
        """Forget subjects that were not heard for long."""
        for subject, watched in list(self._watched.items()):
            if now - watched.heard > SILENT and not watched.remarks:
                self._strangers -= watched.stranger
                del self._watched[subject]

    def _end_silent(self, now: float) -> list[Subject]:
        """End the problems of streams of which nothing came for long. Return the subjects."""
        found = []
        for subject, watched in self._watched.items():
            for stream in watched.streams.values():
                if stream.told and stream.losses.silent(now):
                    stream.told, stream.losses = "", Losses()
                    found.append(subject)
        return found


def limited(problems: dict[str, str]) -> dict[str, str]:
    """Return as many problems as a status lists; the last one counts the others."""
    if len(problems) <= MAX_PROBLEMS:
        return problems
    kept = dict(list(problems.items())[: MAX_PROBLEMS - 1])
    number = len(problems) - len(kept)
    return {**kept, "others": f"{number} more problems; the log lines stream_lost and remark tell each"}


def _tell_gap(recent: Recent, robot: str, kind: str, total: int) -> None:
    text = recent.add(Subject(robot), f"gap {kind}", lambda: lost_on_the_way(robot, kind, total))
    if text is not None:
        note(logger, logging.WARNING, "gap", text, robot=robot, reason=kind, missing=total)


def _note_some(subject: Subject, reason: str, text: str) -> None:
    """Log that messages or points are lost here and there."""
    note(logger, logging.INFO, "lost_some", text, robot=subject.robot, reason=str(reason), subject=str(subject))
