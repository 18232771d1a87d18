"""The thread that asks for the map and publishes, on each topic, what has changed."""

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from roughmap_client import RoughMapClient, RoughMapError, Version
from roughmap_ros.out.topics import MapTopic, Shown
from roughmap_ros.out.window import window
from roughmap_schemas.messages import MapStatus

logger = logging.getLogger(__name__)

Position = Callable[[str], tuple[float, float] | None]
"""Returns where a robot is: x and y in the map frame, metres; None before its first pose."""

CLOSING_S: Final = 5.0
"""Longest wait for a query that is under way at the end."""

EARLY_S: Final = 0.002
"""Topics that are due within this time are published together: one status for all."""


MAX_ROS_NS: Final = 2**31 * 10**9 - 1
"""The last stamp that a ROS message can hold, in 2038. The map takes later ones."""


class _Scheduled:
    """A topic, when it is looked at next (monotonic s), and what it showed last."""

    def __init__(self, topic: MapTopic) -> None:
        self.topic = topic
        self.due = 0.0
        self.held: Version | None = None
        self.problem = ""


class MapPublisher:
    """Publishes topics in a thread: each at most ``rate`` times a second, and only if the map has changed."""

    def __init__(self, topics: Mapping[str, MapTopic], client: RoughMapClient, position: Position) -> None:
        self._topics = {name: _Scheduled(topic) for name, topic in topics.items()}
        self._client = client
        self._position = position
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ros2-out", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End; wait a few seconds at most for what is being sent."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(CLOSING_S)

    def problems(self) -> dict[str, str]:
        """Return why topics can't be published at present, by their names."""
        return {name: text for name, one in self._topics.items() if (text := one.problem)}

    def _run(self) -> None:
        scheduled = list(self._topics.values())
        while not self._closing.wait(max(min(one.due for one in scheduled) - time.monotonic(), 0.0)):
            now = time.monotonic()
            due = [one for one in scheduled if one.due <= now + EARLY_S]
            for one in due:
                one.due = now + 1 / one.topic.out.rate
            try:
                self._publish(due)
            except Exception:  # without this thread no topic goes on
                if self._closing.is_set():
                    return
                logger.exception("cannot publish the map on ROS topics; trying again")

    def _publish(self, due: Sequence[_Scheduled]) -> None:
        try:
            status = self._client.status()
        except RoughMapError as error:
            for one in due:
                one.problem = str(error)
            return
        version = Version(status.epoch, status.sequence, status.instance)
        for one in due:
            if one.held == version:
                one.topic.rest()
                one.problem = ""
                continue
            try:
                one.held = self._show(one.topic, status) or one.held
                one.problem = ""
            except RoughMapError as error:
                one.problem = str(error)
            except OverflowError:
                one.problem = f"the position of {one.topic.robot} is beyond all maps"

    def _show(self, topic: MapTopic, status: MapStatus) -> Version | None:
        """Publish a topic; return the state of the map that it shows, None if its robot has no pose yet."""
        out = topic.out
        cells = window(out, status.cell_size, None if out.box is not None else self._position(topic.robot))
        if cells is None:
            return None
        region = self._client.region(cells.asked, topic.layers, level=out.level)
        stamp_ns = min(status.newest_stamp_ns or time.time_ns(), MAX_ROS_NS)
        topic.show(Shown(region, cells, status.frame_id, stamp_ns))
        return region.version
