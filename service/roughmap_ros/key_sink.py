"""Robots' messages onto the keys of the contract, for a service that runs elsewhere."""

import threading
from collections.abc import Mapping
from typing import Final

import zenoh

from roughmap_schemas import Keys, encodings
from roughmap_schemas.kinds import Kind, RobotMessage

ENCODINGS: Final[Mapping[Kind, str]] = {
    Kind.POINTS: encodings.POINT_CLOUD,
    Kind.ODOMETRY: encodings.ODOMETRY,
    Kind.TRANSFORM: encodings.FRAME_TRANSFORM,
}


class KeySink:
    """Publishes robots' messages, each numbered as the contract has it, so that lost ones are counted."""

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._session = session
        self._keys = keys
        self._lock = threading.Lock()
        self._publishers: dict[tuple[str, Kind], zenoh.Publisher] = {}
        self._numbers: dict[tuple[str, Kind], int] = {}

    def put(self, robot: str, message: RobotMessage) -> None:
        """Publish a message of a robot; one thread at a time for each robot. It waits while the link is full."""
        of = robot, message.kind
        with self._lock:
            publisher = self._publishers.get(of) or self._declare(robot, message.kind)
            number = self._numbers.get(of, 0)
            self._numbers[of] = number + 1
        publisher.put(message.payload, attachment=number.to_bytes(8, "little"))

    def _declare(self, robot: str, kind: Kind) -> zenoh.Publisher:
        publisher = self._publishers[robot, kind] = self._session.declare_publisher(
            self._keys.form(kind.value).make(robot=robot),
            encoding=ENCODINGS[kind],
            congestion_control=zenoh.CongestionControl.BLOCK,
            # Poses overtake clouds: they are small, and clouds wait for them.
            priority=zenoh.Priority.DATA if kind is Kind.POINTS else zenoh.Priority.DATA_HIGH,
        )
        return publisher
