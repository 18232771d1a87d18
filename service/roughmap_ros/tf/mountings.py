"""Where the sensors are on the robot, from transforms; clouds that wait for it."""

from collections import deque
from collections.abc import Collection
from typing import Final, NamedTuple

from roughmap_ros.tf.rigid import Rigid, differ
from roughmap_ros.tf.tree import Tree
from roughmap_schemas import encode_transform
from roughmap_schemas.kinds import Kind, RobotMessage

MAX_HELD: Final = 8
"""Clouds of a sensor that wait for its mounting, nearly a second at 10 Hz: static transforms come at once."""

MOVED_M: Final = 1e-4
MOVED_RAD: Final = 1e-4
"""How far a sensor on moving links must move to be told anew: 5 mm at 50 m, and more than a joint's noise."""


class HeldCloud(NamedTuple):
    """A cloud that waits, and its stamp."""

    stamp_ns: int
    message: RobotMessage


class Mountings:
    """The poses of sensors in the base frame, each told when it is known and when it changes.

    A sensor on links that are not static is looked up at the stamp of each of its clouds.

    Attributes:
        sensors: the sensors' frames.
        known: the sensors' poses as they were told last.
        lost: clouds of a sensor that were given up, since there was no room to hold them.
        moving: sensors that moved.
    """

    def __init__(self, tree: Tree, base: str, sensors: Collection[str]) -> None:
        self.tree = tree
        self.base = base
        self.sensors = tuple(sorted(set(sensors)))
        self.known: dict[str, Rigid] = {}
        self.lost = dict.fromkeys(self.sensors, 0)
        self.moving: set[str] = set()
        self._held: dict[str, deque[HeldCloud]] = {sensor: deque() for sensor in self.sensors}
        self._version = -1

    def take(self, sensor: str, stamp_ns: int, cloud: RobotMessage) -> list[RobotMessage]:
        """Take a cloud of one of the sensors. Return its mounting, if that is new or changed, and the cloud."""
        if sensor not in self.known:
            held = self._held[sensor]
            held.append(HeldCloud(stamp_ns, cloud))
            if len(held) > MAX_HELD:
                held.popleft()
                self.lost[sensor] += 1
            return self.changed(cloud.log_ns)
        return [*self._mounting(sensor, stamp_ns, cloud.log_ns), cloud]

    def changed(self, log_ns: int) -> list[RobotMessage]:
        """Return the mountings that are new or changed, and after each the clouds that waited for it."""
        if self._version == self.tree.version:
            return []
        self._version = self.tree.version
        messages: list[RobotMessage] = []
        for sensor in self.sensors:
            if sensor in self.known and not self.is_static(sensor):
                continue
            held = self._held[sensor]
            messages += self._mounting(sensor, held[0].stamp_ns if held else self._newest_ns(sensor), log_ns)
            if sensor in self.known:
                while held:
                    stamp_ns, cloud = held.popleft()
                    messages += self._mounting(sensor, stamp_ns, log_ns)
                    messages.append(cloud._replace(log_ns=log_ns))
        return messages

    def rest(self, log_ns: int) -> list[RobotMessage]:
        """Return the clouds that still wait: their sensors' mounting never came."""
        rest = [cloud.message._replace(log_ns=log_ns) for held in self._held.values() for cloud in held]
        for held in self._held.values():
            held.clear()
        return rest

    def is_static(self, sensor: str) -> bool:
        """Return whether all links between the base and a sensor are static."""
        return all(step.link.static for step in self.tree.chain(self.base, sensor) or ())

    def _newest_ns(self, sensor: str) -> int:
        return max((step.link.newest_ns for step in self.tree.chain(self.base, sensor) or ()), default=0)

    def _mounting(self, sensor: str, stamp_ns: int, log_ns: int) -> list[RobotMessage]:
        pose, told = self.tree.find(self.base, sensor, stamp_ns), self.known.get(sensor)
        if pose is None or pose == told:
            return []
        if told is not None and not self.is_static(sensor):
            if not differ(told, pose, MOVED_M, MOVED_RAD):
                return []
            self.moving.add(sensor)
        self.known[sensor] = pose
        payload = encode_transform(0, self.base, sensor, pose.translation, pose.rotation)
        return [RobotMessage(Kind.TRANSFORM, payload, log_ns)]
