"""Events as they are published while they happen."""

import logging
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas import Keys
from roughmap_schemas.encodings import json_encoding

logger = logging.getLogger(__name__)


class EventPublisher:
    """Publishes events; a context manager.

    Events are dropped rather than waited for: the log has them, and a reader that stalls must not hold up the
    sequencer. They have a priority of their own, because in Zenoh a sender that waits for room in a link's queue holds
    up all senders of the same priority, and updates and replies do wait.
    """

    def __init__(self, session: zenoh.Session, keys: Keys) -> None:
        self._publisher = session.declare_publisher(
            keys.events,
            encoding=json_encoding("Event"),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_HIGH,
        )

    def publish(self, event: bytes) -> None:
        """Publish an event's JSON; never blocks, never raises."""
        try:
            self._publisher.put(event)
        except zenoh.ZError as error:
            logger.warning("could not publish an event: %s", error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._publisher.undeclare()
