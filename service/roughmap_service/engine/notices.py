"""What an operator should see of the messages that came in: counters and log lines."""

import logging
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

from roughmap_schemas import Config, Odometry, PoseReason, SensorTimeEvent, Transform
from roughmap_service.engine.figures import figure, pose_figures
from roughmap_service.engine.odd_habits import Habits
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.remedies import Subject, sensor_table, time_form_remedy
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.decoding import Content
from roughmap_service.run.mountings import Mounted, Mounting
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.run import NoTimes, Taken

logger = logging.getLogger(__name__)

ORIGINS = {
    "start": "counted from the cloud's stamp",
    "end": "counted back from the cloud's stamp",
    "absolute": "as times since 1970",
}

MOUNTING_MOVED_M, MOUNTING_MOVED_RAD = 1e-3, math.radians(0.1)
"""How far a sensor's mounting moves before that is told."""


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
        self._mountings: dict[tuple[str, str], Mounting] = {}
        self._habits = Habits(streams, states)

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
        if taken.mounted is not None:
            self._mounted(robot, taken.mounted)
        if taken.jumped and isinstance(content, Transform):
            self._counters.jump(robot)
            text = (
                f"its transform {content.parent_frame_id} -> {content.child_frame_id} jumped; "
                "ground that is already mapped does not move"
            )
            self._tell(Subject(robot), "jump", text, child_frame_id=content.child_frame_id)

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
        subject, text = Subject(robot, frame_id), None
        if shown:
            where = "ahead of" if shown > 0 else "behind"
            text = (
                f"its clock moved: it is {abs(shown)} s {where} the odometry's; use one clock, or set "
                f"time_offset in {sensor_table(config, robot, frame_id)}"
            )
        self._streams.remark(subject, "clock", text)
        if late:
            text = f"its clouds come {late} s later than at first: a slower way, or its clock fell behind"
            self._tell(subject, "sensor_late", text, frame_id=frame_id, seconds=late)

    def times(self, found: SensorTimeEvent | NoTimes, config: Config) -> None:
        """Notice how a sensor's times are read, or that it is unclear."""
        subject = Subject(found.robot, found.frame_id)
        if isinstance(found, SensorTimeEvent):
            text = (
                f"points' times are read from field {found.field!r} in {found.unit}, {ORIGINS[found.origin]}"
                if found.field
                else "points have no times of their own; all lie at the cloud's stamp"
            )
            self._tell(subject, "sensor_time", text, logging.INFO, frame_id=found.frame_id)
            self._unclear.discard((found.robot, found.frame_id))
        elif (found.robot, found.frame_id) not in self._unclear:  # once: that clouds are lost is told by the streams
            self._unclear.add((found.robot, found.frame_id))
            remedy = time_form_remedy(found.seen, sensor_table(config, found.robot, found.frame_id))
            text = f"{subject}: what the times of its points mean is unclear: {found.seen}; {remedy}"
            note(logger, logging.WARNING, "time_form", text, robot=found.robot, frame_id=found.frame_id)

    def _mounted(self, robot: str, mounted: Mounted) -> None:
        """Notice that a sensor's mounting came, or is no longer where it was when that was told last."""
        frame_id, new, before = mounted
        subject, shown = Subject(robot, frame_id), ", ".join(f"{value:.4g}" for value in new.translation)
        known = self._mountings.setdefault((robot, frame_id), new if before is None else before)
        if before is None:
            text = f"its mounting came: {new.parent} -> {frame_id} at {shown} m"
            self._tell(subject, "mounting", text, logging.INFO, frame_id=frame_id)
            return
        metres, radians = known.moved(new)
        if metres > MOUNTING_MOVED_M or radians > MOUNTING_MOVED_RAD or new.parent != known.parent:
            self._mountings[robot, frame_id] = new
            text = (
                f"its mounting changed by {metres:.3g} m, {math.degrees(radians):.2f} degrees: {new.parent} -> "
                f"{frame_id} at {shown} m; what is already mapped does not move"
            )
            self._tell(subject, "mounting_changed", text, frame_id=frame_id)

    def _tell(self, subject: Subject, event: str, text: str, level: int = logging.WARNING, **fields: Any) -> None:
        """Log what happened once, and list it for a while."""
        self._streams.happened(subject, event, text)
        note(logger, level, event, f"{subject}: {text}", robot=subject.robot, **fields)

    def _two_sources(self, robot: str) -> None:
        """Tell that a robot's odometry comes from two sources, and that it no longer does."""
        mixed = self._states[robot].clock.two_sources
        if mixed == (robot in self._mixed):
            return
        text = None
        if mixed:
            self._mixed.add(robot)
            text = (
                "its odometry comes from two sources out of step; poses are sorted by stamp, which costs clouds and "
                "accuracy; let only one of them send"
            )
        else:
            self._mixed.remove(robot)
        self._streams.remark(Subject(robot), "two_sources", text)

    def _odometry(self, robot: str, odometry: Odometry, taken: OdometryTaken) -> None:
        for reason, stamp_ns in zip(taken.settled, taken.stamps, strict=True):
            self._counters.pose(reason)
            figures = partial(pose_figures, reason, stamp_ns, odometry.frame_id, self._states[robot], taken.why)
            self._streams.pose(robot, reason, figures)
        if taken.ended_from:  # not after a reset, or wild stamps at first: nothing is lost then
            text = (
                "its stamps went back: its clock was set, a recording began again, or two programs publish its "
                "odometry; its poses begin anew, and clouds from before are rejected; let its clock be steered "
                "(chrony, PTP) and not set while it runs"
            )
            self._tell(Subject(robot), "clock_reset", text)
        self._two_sources(robot)
        if taken.verdict is Verdict.FORWARD and taken.leapt_s > 0.0:
            text = f"its clock leapt {taken.leapt_s:.1f} s forward, or it sent no pose for as long"
            self._tell(Subject(robot), "clock_forward", text, seconds=taken.leapt_s)
        if taken.leap is not None:
            leap = taken.leap
            self._counters.jump(robot)
            text = (
                f"its pose leapt {figure(leap.metres)} m, {leap.radians:.2f} rad in {leap.seconds:.3f} s; "
                "clouds over the leap are rejected, and ground that is already mapped does not move; publish a "
                "localisation's corrections as a transform, or raise input.max_leap if the robot moves like that"
            )
            metres = leap.metres if math.isfinite(leap.metres) else None  # JSON has no infinity
            self._tell(Subject(robot), "leap", text, metres=metres, seconds=leap.seconds)
        if taken.unestimated and robot not in self._unestimated:
            self._unestimated.add(robot)
            text = "its odometry does not estimate all of its covariance; input.pose_sigma stands in: check its values"
            self._tell(Subject(robot), "covariance_unknown", text, logging.INFO)
        self._habits.look(robot, odometry.frame_id)
