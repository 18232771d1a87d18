"""The service as a ROS 2 node: robots' topics go into the input queue, and what is wrong with them is told."""

import logging
import time
from contextlib import ExitStack
from types import TracebackType
from typing import Final, Self

import zenoh

from roughmap_client import RoughMapClient
from roughmap_ros.bridge import Bridge, robot_feeds, ros_node
from roughmap_ros.wire import Received
from roughmap_ros.wire.refusals import LARGER
from roughmap_schemas import Config, MessageFault, Refusal
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.admission import refuse
from roughmap_service.inputs.gaps import Gaps
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.inputs.ros2_checks import standing
from roughmap_service.inputs.ros2_problems import Told
from roughmap_service.inputs.streams import Streams

logger = logging.getLogger(__name__)

QUERY_S: Final = 2.0
"""Longest wait of an answer to the service's own query."""


class Ros2Inputs:
    """Takes part in ROS 2 on the service's session; a context manager."""

    def __init__(
        self, session: zenoh.Session, config: Config, queue: InputQueue, counters: Counters, streams: Streams
    ) -> None:
        self._session = session
        self._config = config
        self._queue = queue
        self._counters = counters
        self._streams = streams
        self._gaps = Gaps()
        self._stack = ExitStack()
        self._told = Told(dict)

    def __enter__(self) -> Self:
        config, session = self._config, self._session
        with ExitStack() as stack:
            node = stack.enter_context(ros_node(session, config))
            client = RoughMapClient(config.map.name, session=session, timeout=QUERY_S, keys=config.keys)
            bridge = Bridge(
                node, config.ros2, robot_feeds(config), self._put, self._refuse, client, heard=self._count_lost
            )
            stack.enter_context(bridge)
            self._told = stack.enter_context(Told(bridge.problems))
            self._stack = stack.pop_all()
        text = standing(config)
        if text is not None:
            note(logger, logging.WARNING, "ros2_router", text, always=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def problems(self) -> dict[str, str]:
        """Return the problems that last, a sentence for each subject."""
        return self._told.problems()

    def _put(self, robot: str, message: RobotMessage) -> None:
        size, limit = len(message.payload), self._config.input.max_message
        if size > limit:
            text = f"the message has {size} bytes (input.max_message: {limit})"
            refuse(self._counters, self._streams, robot, message.kind, MessageFault(Refusal.TOO_LARGE, text))
            return
        self._queue.put(InputMessage(message.kind, robot, message.payload, message.log_ns, time.monotonic()))

    def _refuse(self, robot: str, kind: Kind, text: str) -> None:
        code = Refusal.TOO_LARGE if f": {LARGER} " in text else Refusal.BAD_MESSAGE
        refuse(self._counters, self._streams, robot, kind, MessageFault(code, text))

    def _count_lost(self, robot: str, kind: Kind, topic: str, received: Received) -> None:
        """Count messages that were lost on the way, by the numbers that ROS publishers give theirs."""
        if received.sequence is None or received.gid is None:
            return
        lost = self._gaps.sourced(f"{robot}{topic}", received.gid.hex(), received.sequence)
        if lost:
            self._counters.gap(robot, lost)
            self._streams.gap(robot, kind.value, lost)
