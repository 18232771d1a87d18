"""What an operator should see of the messages that came in: counters and log lines."""

import logging
import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from roughmap_schemas import Config, Odometry, PoseReason, SensorTimeEvent, Transform
from roughmap_service.engine.figures import pose_figures
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.remedies import sensor_table, time_form_remedy
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.decoding import Content
from roughmap_service.run.habits import BURST_REMEDY, JITTER_REMEDY, find_bursts, find_jitter
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.run import NoTimes, Taken
from roughmap_service.run.settings import NS

logger = logging.getLogger(__name__)

ORIGINS = {
    "start": "counted from the cloud's stamp",
    "end": "counted back from the cloud's stamp",
    "absolute": "as times since 1970",
}


LOOKED_AT, LATELY_NS = 400, 2 * NS
"""Poses of a robot that are looked at for odd habits: so many, of so much time."""

ENOUGH, ENOUGH_NS = 30, NS // 4
"""The fewest, and the time that they must cover."""

LOOK_S, APART_S = 5.0, 0.2
"""Seconds between two looks at one robot, and at any two: a look takes up to 8 ms."""


class Notices:
    """Counts accepted and rejected poses, and logs what is unusual.

    ``states`` are the run's robots; ``robots`` are the names of those that were heard before.
    """

    def __init__(self, counters: Counters, streams: Streams, states: Mapping[str, Robot], robots: set[str]) -> None:
        self._counters = counters
        self._states = states
        self._streams = streams
        self._robots = robots
        self._unestimated: set[str] = set()
        self._mixed: set[str] = set()
        self._clocks: dict[tuple[str, str], tuple[float, float]] = {}
        self._unclear: set[tuple[str, str]] = set()
        self._next_look: dict[str, float] = {}
        self._next_any = 0.0

    def message(self, robot: str, content: Content, taken: Taken) -> None:
        """Notice what a logged message led to."""
        if robot not in self._robots:
            self._robots.add(robot)
            note(logger, logging.INFO, "robot", f"robot {robot}: first message", robot=robot)
        if isinstance(content, Odometry) and taken.odometry is not None:
            self._odometry(robot, content, taken.odometry)
        elif taken.rejected is not None:
            self._counters.pose(PoseReason.POSE_FRAME)
        if isinstance(content, Transform):
            self._streams.transform(robot)
        if taken.jumped and isinstance(content, Transform):
            self._counters.jump(robot)
            text = (
                f"robot {robot}: its transform {content.parent_frame_id} -> {content.child_frame_id} jumped; "
                "ground that is already mapped does not move"
            )
            self._tell(f"robot {robot}", "jump", text, robot=robot, child_frame_id=content.child_frame_id)

    def sensor(self, robot: str, frame_id: str, config: Config) -> None:
        """Notice what the last cloud of a sensor shows of its clock."""
        sensor = self._states[robot].sensors.get(frame_id) if robot in self._states else None
        if sensor is None:
            return
        # Beyond the limit its clouds are lost, which is told with the same figure.
        shown = 0.0 if sensor.differs else round(sensor.offset_ns * 1e-9, 1)
        late = round(sensor.late_ns * 1e-9, 1)
        if self._clocks.get((robot, frame_id), (0.0, 0.0)) == (shown, late):
            return
        self._clocks[robot, frame_id] = shown, late
        subject = f"robot {robot} sensor {frame_id}"
        text = None
        if shown:
            where = "ahead of" if shown > 0 else "behind"
            text = (
                f"{subject}: its clock moved: it is {abs(shown)} s {where} the odometry's; use one clock, or set "
                f"time_offset in {sensor_table(config, robot, frame_id)}"
            )
        self._streams.remark(subject, "clock", text)
        if late:
            text = f"{subject}: its clouds come {late} s later than at first: a slower way, or its clock fell behind"
            self._tell(subject, "sensor_late", text, robot=robot, frame_id=frame_id, seconds=late)

    def times(self, found: SensorTimeEvent | NoTimes, config: Config) -> None:
        """Notice how a sensor's times are read, or that it is unclear."""
        sensor = f"robot {found.robot} sensor {found.frame_id}"
        if isinstance(found, SensorTimeEvent):
            text = (
                f"{sensor}: points' times are read from field {found.field!r} in {found.unit}, {ORIGINS[found.origin]}"
                if found.field
                else f"{sensor}: points have no times of their own; all lie at the cloud's stamp"
            )
            self._tell(sensor, "sensor_time", text, logging.INFO, robot=found.robot, frame_id=found.frame_id)
            self._unclear.discard((found.robot, found.frame_id))
        elif (found.robot, found.frame_id) not in self._unclear:  # once: that clouds are lost is told by the streams
            self._unclear.add((found.robot, found.frame_id))
            remedy = time_form_remedy(found.seen, sensor_table(config, found.robot, found.frame_id))
            text = f"{sensor}: what the times of its points mean is unclear: {found.seen}; {remedy}"
            note(logger, logging.WARNING, "time_form", text, robot=found.robot, frame_id=found.frame_id)

    def _tell(self, subject: str, event: str, text: str, level: int = logging.WARNING, **fields: Any) -> None:
        """Log what happened once, and list it for a while; ``text`` begins with the subject."""
        note(logger, level, event, text, **fields)
        self._streams.recent.add(subject, event, lambda: text)

    def _two_sources(self, robot: str) -> None:
        """Tell that a robot's odometry comes from two sources, and that it no longer does."""
        mixed = self._states[robot].clock.two_sources
        if mixed == (robot in self._mixed):
            return
        text = None
        if mixed:
            self._mixed.add(robot)
            text = (
                f"robot {robot}: its odometry comes from two sources out of step; poses are sorted by stamp, which "
                "costs clouds and accuracy; let only one of them send"
            )
        else:
            self._mixed.remove(robot)
        self._streams.remark(f"robot {robot}", "two_sources", text)

    def _habits(self, robot: str, frame_id: str) -> None:
        """Tell now and then what is odd about a robot's odometry though it is taken."""
        now, state = time.monotonic(), self._states[robot]
        if now < max(self._next_any, self._next_look.get(robot, 0.0)):
            return
        poses = state.buffer.poses[-LOOKED_AT:]
        poses = [pose for pose in poses if pose.stamp_ns > poses[-1].stamp_ns - LATELY_NS]
        if len(poses) < ENOUGH or poses[-1].stamp_ns - poses[0].stamp_ns < ENOUGH_NS:
            return
        self._next_any, self._next_look[robot] = now + APART_S, now + LOOK_S
        found = {}
        if bursts := find_bursts([[pose.stamp_ns for pose in poses]]):
            found["bursts"] = f"its {bursts}; {BURST_REMEDY}"
        elif not state.clock.two_sources and (jitter := find_jitter([poses])):
            found["jitter"] = f"its odometry {jitter}; {JITTER_REMEDY}"
        ahead = state.transforms.ahead(frame_id, poses[-1].stamp_ns)
        if ahead > NS:
            found["transform_ahead"] = (
                f"the transform to {frame_id!r} is stamped {ahead / NS:,.1f} s later than its poses: it holds as a "
                "static one; stamp it on the poses' clock, or with 0"
            )
        for name, text in found.items():
            told = f"robot {robot}: {text}"
            if self._streams.recent.add(f"robot {robot}", name, lambda told=told: told):  # type: ignore[misc]
                note(logger, logging.WARNING, "habit", told, robot=robot, reason=name)

    def _odometry(self, robot: str, odometry: Odometry, taken: OdometryTaken) -> None:
        for reason, stamp_ns in zip(taken.settled, taken.stamps, strict=True):
            self._counters.pose(reason)
            figures = partial(pose_figures, reason, stamp_ns, odometry.frame_id, self._states[robot], taken.why)
            self._streams.pose(robot, reason, figures)
        if taken.ended_from:  # not after a reset, or wild stamps at first: nothing is lost then
            text = (
                f"robot {robot}: its stamps went back: its clock was set, a recording began again, or two programs "
                "publish its odometry; its poses begin anew, and clouds from before are rejected"
            )
            self._tell(f"robot {robot}", "clock_reset", text, robot=robot)
        self._two_sources(robot)
        if taken.verdict is Verdict.FORWARD and taken.leapt_s > 0.0:
            text = f"robot {robot}: its clock leapt {taken.leapt_s:.1f} s forward, or it sent no pose for as long"
            self._tell(f"robot {robot}", "clock_forward", text, robot=robot, seconds=taken.leapt_s)
        if taken.leap is not None:
            leap = taken.leap
            self._counters.jump(robot)
            text = (
                f"robot {robot}: its pose leapt {leap.metres:.2f} m, {leap.radians:.2f} rad in {leap.seconds:.3f} s; "
                "clouds over the leap are rejected, and ground that is already mapped does not move; publish a "
                "localisation's corrections as a transform, or raise input.max_leap if the robot moves like that"
            )
            metres = leap.metres if math.isfinite(leap.metres) else None  # JSON has no infinity
            self._tell(f"robot {robot}", "leap", text, robot=robot, metres=metres, seconds=leap.seconds)
        if taken.unestimated and robot not in self._unestimated:
            self._unestimated.add(robot)
            text = f"robot {robot}: its odometry does not estimate all of its covariance; input.pose_sigma stands in"
            self._tell(f"robot {robot}", "covariance_unknown", text, logging.INFO, robot=robot)
        self._habits(robot, odometry.frame_id)
