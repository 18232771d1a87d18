"""Looks now and then at each robot's odometry for what is odd though it is taken, and tells it."""

import logging
import time
from collections.abc import Mapping

from roughmap_service.host.log_lines import note
from roughmap_service.inputs.remedies import Subject
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.habits import BURST_REMEDY, JITTER_REMEDY, Bursts, find_bursts, find_jitter, later_transform
from roughmap_service.run.robot import Robot
from roughmap_service.run.settings import NS

logger = logging.getLogger(__name__)

LATELY_NS, ENOUGH, MOST = 2 * NS, 30, 400
"""Poses that are looked at: those of the last 2 s, but at least and at most so many."""

ENOUGH_NS = NS // 4
"""The time that they must cover."""

LOOK_S, APART_S = 2.5, 0.1
"""Seconds between two looks at one robot, and at any two: a look takes some milliseconds."""

TWICE = 2
"""Looks in a row that must agree that stamps come in bursts, or that they don't any more."""


class Habits:
    """``states`` are the run's robots. For one thread; it decides nothing."""

    def __init__(self, streams: Streams, states: Mapping[str, Robot]) -> None:
        self._streams = streams
        self._states = states
        self._next_look: dict[str, float] = {}
        self._next_any = 0.0
        self._in_bursts: set[str] = set()
        self._otherwise: dict[str, int] = {}
        """Looks in a row that said otherwise than what is told, by robot."""

    def look(self, robot: str, frame_id: str) -> None:
        """Look at a robot's poses, if it is time; its odometry is in this frame."""
        now, state = time.monotonic(), self._states[robot]
        if now < max(self._next_any, self._next_look.get(robot, 0.0)):
            return
        poses = state.buffer.poses[-MOST:]
        late = sum(pose.stamp_ns > poses[-1].stamp_ns - LATELY_NS for pose in poses)
        poses = poses[-max(late, ENOUGH) :]
        if len(poses) < ENOUGH or poses[-1].stamp_ns - poses[0].stamp_ns < ENOUGH_NS:
            return
        self._next_any, self._next_look[robot] = now + APART_S, now + LOOK_S
        bursts = find_bursts([[pose.stamp_ns for pose in poses]])
        self._tell_bursts(robot, bursts)
        if not bursts and not state.clock.two_sources and (jitter := find_jitter([poses])):
            self._list(robot, "jitter", f"its odometry {jitter}; {JITTER_REMEDY}")
        if later := later_transform(frame_id, state.transforms.ahead(frame_id, poses[-1].stamp_ns)):
            self._list(robot, "transform_ahead", f"{later}; stamp it on the poses' clock, or with 0")

    def _tell_bursts(self, robot: str, bursts: Bursts | None) -> None:
        """Scans are placed by wrong times then: a problem as long as it lasts."""
        told = robot in self._in_bursts
        self._otherwise[robot] = self._otherwise.get(robot, 0) + 1 if bool(bursts) != told else 0
        if self._otherwise[robot] < TWICE:
            return
        self._otherwise[robot] = 0
        if bursts:
            self._in_bursts.add(robot)
        else:
            self._in_bursts.remove(robot)
        text = f"its {bursts}; {BURST_REMEDY}" if bursts else None
        self._streams.remark(Subject(robot), "bursts", text)

    def _list(self, robot: str, reason: str, text: str) -> None:
        if told := self._streams.happened(Subject(robot), reason, text):
            note(logger, logging.WARNING, "habit", told, robot=robot, reason=reason)
