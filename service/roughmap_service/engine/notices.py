"""What an operator should see of the messages that came in: counters and log lines."""

import json
import logging

from roughmap_schemas import PoseReason, SensorTimeEvent, Transform
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.run.decoding import Content
from roughmap_service.run.robot import OdometryTaken
from roughmap_service.run.run import NoTimes, Taken

logger = logging.getLogger(__name__)

ORIGINS = {
    "start": "counted from the cloud's stamp",
    "end": "counted back from the cloud's stamp",
    "absolute": "as times since 1970",
}


class Notices:
    """Counts accepted and rejected poses, and logs what is unusual; ``robots`` are those that were heard before."""

    def __init__(self, counters: Counters, robots: set[str]) -> None:
        self._counters = counters
        self._robots = robots
        self._unestimated: set[str] = set()

    def message(self, robot: str, content: Content, taken: Taken) -> None:
        """Notice what a logged message led to."""
        if robot not in self._robots:
            self._robots.add(robot)
            note(logger, logging.INFO, "robot", f"robot {robot}: first message", robot=robot)
        if taken.odometry is not None:
            self._odometry(robot, taken.odometry)
        elif taken.rejected is not None:
            self._counters.pose(PoseReason.POSE_FRAME)
        if taken.jumped and isinstance(content, Transform):
            self._counters.jump(robot)
            text = (
                f"robot {robot}: its transform {content.parent_frame_id} -> {content.child_frame_id} jumped; "
                "ground that is already mapped does not move"
            )
            note(logger, logging.WARNING, "jump", text, robot=robot, child_frame_id=content.child_frame_id)

    def times(self, found: SensorTimeEvent | NoTimes) -> None:
        """Notice how a sensor's times are read, or that it is unclear."""
        sensor = f"robot {found.robot} sensor {found.frame_id}"
        if isinstance(found, SensorTimeEvent):
            text = (
                f"{sensor}: points' times are read from field {found.field!r} in {found.unit}, {ORIGINS[found.origin]}"
                if found.field
                else f"{sensor}: points have no times of their own; all lie at the cloud's stamp"
            )
            note(logger, logging.INFO, "sensor_time", text, robot=found.robot, frame_id=found.frame_id)
        else:
            text = (
                f"{sensor}: clouds rejected, since the meaning of their points' times is unclear: {found.seen}. Set "
                f"time_field, time_unit and time_origin in [sensors.{json.dumps(found.frame_id)}]"
            )
            note(logger, logging.WARNING, "time_form", text, robot=found.robot, frame_id=found.frame_id)

    def _odometry(self, robot: str, taken: OdometryTaken) -> None:
        for reason in taken.settled:
            self._counters.pose(reason)
        if taken.verdict.begins_anew:
            text = f"robot {robot}: its clock went back; its poses begin anew, and clouds from before are rejected"
            note(logger, logging.WARNING, "clock_reset", text, robot=robot)
        if taken.two_sources:
            text = (
                f"robot {robot}: its odometry comes from two sources out of step; poses are now sorted by stamp. "
                "Let only one of them send"
            )
            note(logger, logging.WARNING, "two_sources", text, robot=robot)
        if taken.leap is not None:
            leap = taken.leap
            self._counters.jump(robot)
            text = (
                f"robot {robot}: its pose leapt {leap.metres:.2f} m, {leap.radians:.2f} rad in {leap.seconds:.3f} s; "
                "clouds over the leap are rejected, and ground that is already mapped does not move"
            )
            note(logger, logging.WARNING, "leap", text, robot=robot, metres=leap.metres, seconds=leap.seconds)
        if taken.unestimated and robot not in self._unestimated:
            self._unestimated.add(robot)
            text = f"robot {robot}: its odometry does not estimate all of its covariance; input.pose_sigma stands in"
            note(logger, logging.INFO, "covariance_unknown", text, robot=robot)
