"""A robot that is told odometry by its stamps alone."""

from collections.abc import Sequence

from service_tools import LEVEL, PRECISE, config

from roughmap_schemas import Odometry
from roughmap_service.run.odometry_clock import Verdict
from roughmap_service.run.robot import OdometryTaken, Robot
from roughmap_service.run.settings import Settings

TENTH = 10**8
SETTINGS = Settings(config(input={"max_pose_gap": 0.5, "pose_history": 10.0}))


class Heard:
    """A robot that is told odometry of these stamps, in tenths of a second; inputs are numbered from 1."""

    def __init__(self, stamps: Sequence[float] = ()) -> None:
        self.robot = Robot(SETTINGS, "rover")
        self.inputs = 0
        self.stamps: dict[int, int] = {}
        self.open: list[int] = []
        for t in stamps:
            self.add(t)

    def add(self, t: float, frame: str = "map") -> OdometryTaken:
        self.inputs += 1
        stamp = self.stamps[self.inputs] = round(t * TENTH)
        message = Odometry(stamp, frame, "base", (0.0, 0.0, 0.0), LEVEL, PRECISE)
        return self.robot.take_odometry(message, self.inputs, stamp)

    def all(self, stamps: Sequence[float]) -> list[Verdict]:
        return [self.add(t).verdict for t in stamps]

    @property
    def poses(self) -> list[int]:
        """The stamps of its poses, in ns."""
        return [pose.stamp_ns for pose in self.robot.buffer.poses]

    @property
    def inputs_of_poses(self) -> list[int]:
        return [pose.input for pose in self.robot.buffer.poses]
