"""The service as a ROS 2 node: robots' topics go into the input queue, and what is wrong with them is told."""

import logging
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Final, Self

import zenoh

from roughmap_client import RoughMapClient
from roughmap_ros.bridge import Bridge, robot_feeds
from roughmap_ros.out.topics import topic_of
from roughmap_ros.out.window import window
from roughmap_ros.wire import Received, RosNode, enable_timestamps, router_problem
from roughmap_schemas import Config, ConfigFault, MessageFault, Refusal
from roughmap_schemas.kinds import Kind, RobotMessage
from roughmap_schemas.layers import layers_of
from roughmap_schemas.ros2_sections import TOPIC_PATTERN
from roughmap_service.host.counters import Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.admission import refuse
from roughmap_service.inputs.gaps import Gaps
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.inputs.streams import Streams

logger = logging.getLogger(__name__)

QUERY_S: Final = 2.0
"""Longest wait of an answer to the service's own query."""

LOOK_S: Final = 2.0
"""How often is looked at what is wrong."""

TOLD_S: Final = 5.0
"""How long something must have been wrong before it is a problem: at a start, topics and transforms come one by one."""


def prepare(session_config: zenoh.Config, config: Config) -> None:
    """Make a session's configuration fit for ROS 2, if ``[ros2]`` says anything; ConfigFault if it can't be done."""
    if config.ros2.active:
        check_topics(config)
        enable_timestamps(session_config)


def check_topics(config: Config) -> None:
    """Raise ConfigFault for a topic of ``[ros2.out]`` that can never be published."""
    layers, most = layers_of(config.map.surface), config.query.max_region_cells
    taken = {topic: "read" for robot in config.ros2.robots.values() for topic, _ in robot.roles}
    for name, out in config.ros2.out.items():
        topic = topic_of(name, out)
        if re.fullmatch(TOPIC_PATTERN, topic) is None:
            raise ConfigFault(f"ros2.out.{name}: {topic!r} is no ROS topic; set topic")
        for own in (topic, f"{topic}_updates") if out.type == "OccupancyGrid" else (topic,):
            if own in taken:
                raise ConfigFault(f"ros2.out.{name}: {own} is {taken[own]} already; set another topic")
            taken[own] = f"published by ros2.out.{name}"
        missing = [layer for layer in out.layers if layer not in layers]
        if missing:
            raise ConfigFault(f"ros2.out.{name}.layers: a map with surface {config.map.surface!r} has no {missing[0]}")
        if out.level >= config.map.levels:
            raise ConfigFault(
                f"ros2.out.{name}.level: must be below map.levels ({config.map.levels}); found {out.level}"
            )
        try:
            cells = window(out, config.map.cell_size, (0.0, 0.0))
        except OverflowError:
            raise ConfigFault(f"ros2.out.{name}: its window is no size of a map; set a smaller size or box") from None
        if cells is not None and cells.nx * cells.ny > most:
            text = f"its window has {cells.nx} x {cells.ny} cells (query.max_region_cells: {most})"
            raise ConfigFault(f"ros2.out.{name}: {text}; set a smaller size or box, or a higher level")


def standing(config: Config) -> str | None:
    """Say how the service's session keeps ROS nodes from finding each other or itself; None if all is well."""
    zenoh = config.zenoh
    if zenoh.config_file:  # it may say all of this otherwise
        return None
    return router_problem(zenoh.mode, zenoh.listen, config.ros2.keys, scouting=zenoh.scouting)


class Told:
    """Problems that last, each logged when it begins and when it ends. A thread looks for them while it is entered."""

    def __init__(self, find: Callable[[], Mapping[str, str]], clock: Callable[[], float] = time.monotonic) -> None:
        self._find = find
        self._clock = clock
        self._since: dict[str, float] = {}
        self._told: dict[str, str] = {}
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-look", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.set()
        self._thread.join(QUERY_S)

    def problems(self) -> dict[str, str]:
        """Return the problems that last, a sentence for each subject."""
        return self._told

    def look(self) -> None:
        """Find the problems, and log those that began or ended."""
        found, now = self._find(), self._clock()
        self._since = {subject: self._since.get(subject, now) for subject in found}
        lasting = {subject: text for subject, text in found.items() if now - self._since[subject] >= TOLD_S}
        for subject, text in lasting.items():
            if subject not in self._told:
                note(logger, logging.WARNING, "ros2_problem", text, subject=subject, reason=subject)
        for subject in self._told.keys() - lasting.keys():
            note(logger, logging.INFO, "ros2_problem_ended", f"{subject}: no longer", subject=subject, reason=subject)
        self._told = lasting

    def _run(self) -> None:
        while not self._closing.wait(LOOK_S):
            try:
                self.look()
            except Exception:  # later looks may go well
                if not self._closing.is_set():
                    logger.exception("cannot look for problems of ROS topics")


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
            node = stack.enter_context(
                RosNode(
                    session, config.ros2.node, keys=config.ros2.keys, domain=config.ros2.domain,
                    max_message=config.input.max_message,
                )
            )  # fmt: skip
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
        code = Refusal.TOO_LARGE if ": larger than " in text else Refusal.BAD_MESSAGE
        refuse(self._counters, self._streams, robot, kind, MessageFault(code, text))

    def _count_lost(self, robot: str, kind: Kind, topic: str, received: Received) -> None:
        """Count messages that were lost on the way, by the numbers that ROS publishers give theirs."""
        if received.sequence is None or received.gid is None:
            return
        lost = self._gaps.sourced(f"{robot}{topic}", received.gid.hex(), received.sequence)
        if lost:
            self._counters.gap(robot, lost)
            self._streams.gap(robot, kind.value, lost)
