"""What an operator should see of the messages that came in: counters and log lines."""

import logging
from collections.abc import Mapping
from functools import partial

from roughmap_schemas import Odometry, PoseReason, Transform
from roughmap_service.engine.figures import pose_figures
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.streams import Streams
from roughmap_service.run.decoding import Content
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.run import Taken

logger = logging.getLogger(__name__)


class Notices:
    """Counts accepted and rejected poses, and logs what is unusual.

    ``states`` are the run's robots; ``robots`` are those that were heard before.
    """

    def __init__(self, counters: Counters, streams: Streams, states: Mapping[str, Robot], robots: set[str]) -> None:
        self._counters = counters
        self._states = states
        self._streams = streams
        self._robots = robots
        self._unestimated: set[str] = set()

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
            note(logger, logging.WARNING, "jump", text, robot=robot, child_frame_id=content.child_frame_id)

    def _odometry(self, robot: str, odometry: Odometry, taken: OdometryTaken) -> None:
        for reason in taken.settled:
            self._counters.pose(reason)
            figures = partial(pose_figures, reason, odometry, self._states[robot], taken.why)
            self._streams.pose(robot, reason, figures)
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
