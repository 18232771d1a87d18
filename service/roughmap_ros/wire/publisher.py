"""Publishers of CDR messages."""

import itertools
import time
from typing import Final

import zenoh
import zenoh.ext

from roughmap_ros.wire.attachment import Attachment, pack_attachment
from roughmap_ros.wire.errors import zenoh_errors
from roughmap_ros.wire.qos import Qos

HEARTBEAT_S: Final = 0.5
"""How soon a reliable, transient_local publisher tells its last number, so that a subscriber misses nothing."""

ALL: Final = 1000
"""Messages that a publisher which keeps all of them keeps."""


def enable_timestamps(config: zenoh.Config) -> None:
    """Switch on timestamps in a Zenoh configuration: transient_local publishers that aren't reliable need them."""
    config.insert_json5("timestamping/enabled", "true")


class RosPublisher:
    """A publisher of one topic. Put from one thread at a time, so that the numbers go up in the order of sending."""

    def __init__(self, session: zenoh.Session, key: str, topic: str, qos: Qos, gid: bytes | None) -> None:
        """Declare it; ``gid`` None sends no attachments. Raises WireError."""
        self._topic = topic
        self._gid = gid
        self._numbers = itertools.count(1)
        self._late: zenoh.ext.AdvancedPublisher | None = None
        reliability = zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
        drop = zenoh.CongestionControl.DROP
        with zenoh_errors(topic):
            if qos.transient_local:
                detection = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
                self._late = zenoh.ext.declare_advanced_publisher(
                    session,
                    key,
                    congestion_control=drop,
                    reliability=reliability,
                    cache=zenoh.ext.CacheConfig(qos.depth or ALL),
                    publisher_detection=True,
                    sample_miss_detection=detection if qos.reliable else None,
                )
            self._publisher = session.declare_publisher(key, congestion_control=drop, reliability=reliability)

    def put(self, cdr: bytes) -> None:
        """Publish a message in CDR with its header of 4 bytes. Raises WireError if the session is closed."""
        beside = None
        if self._gid is not None:
            beside = pack_attachment(Attachment(next(self._numbers), time.time_ns(), self._gid))
        with zenoh_errors(self._topic):
            (self._late or self._publisher).put(cdr, attachment=beside)

    @property
    def matched(self) -> bool:
        """Whether anyone subscribes now. Those who come later get the last messages too if it is transient_local."""
        status = self._publisher.matching_status
        return bool(getattr(status, "matching", status))  # an object in newer versions of Zenoh

    def undeclare(self) -> None:
        """End it, and forget the messages kept for late subscribers."""
        if self._late is not None:
            self._late.undeclare()
        self._publisher.undeclare()
