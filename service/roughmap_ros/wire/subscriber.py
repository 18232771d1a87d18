"""Subscribers: each message is checked, copied once, and handed on."""

import logging
import time
from collections.abc import Callable
from typing import NamedTuple

import zenoh
import zenoh.ext

from roughmap_ros.wire.attachment import MAX_ATTACHMENT, Attachment, BadAttachment, unpack_attachment
from roughmap_ros.wire.errors import zenoh_errors
from roughmap_ros.wire.matching import NO_HASH, NO_HASH_TEXT, hash_text
from roughmap_ros.wire.publisher import ALL
from roughmap_ros.wire.qos import Qos
from roughmap_ros.wire.refusals import Refusals, larger_than
from roughmap_schemas.faults import ReportedError

logger = logging.getLogger(__name__)


class Received(NamedTuple):
    """A message: its CDR, when it came (ns), and what rmw_zenoh sent beside it: source time (ns), number, gid.

    The last three are None with the keys of zenoh-bridge-ros2dds.
    """

    payload: bytes
    received_ns: int
    source_ns: int | None = None
    sequence: int | None = None
    gid: bytes | None = None


class Intake(NamedTuple):
    """How messages of a topic are checked: ``type_hash`` None takes messages without attachment, of any hash."""

    topic: str
    ros_type: str
    type_hash: str | None
    max_message: int
    refusals: Refusals
    callback: Callable[[Received], None]

    def take(self, sample: zenoh.Sample) -> None:
        """Check a message, copy it and call back; raises nothing. For Zenoh's threads."""
        now = time.time_ns()
        try:
            beside = self._check(sample)
            payload = sample.payload.to_bytes()
            if beside is None:
                self.callback(Received(payload, now))
            else:
                self.callback(Received(payload, now, beside.source_ns, beside.sequence, beside.gid))
        except ReportedError as error:
            self.refusals.count(self.topic, str(error)[:500])
        except Exception:
            self.refusals.count(self.topic, "an internal error; see the log lines")
            logger.exception("a message of %s failed", self.topic)

    def _check(self, sample: zenoh.Sample) -> Attachment | None:
        """Return what is to be known beside the payload; raises Refused and BadAttachment. Copies no payload."""
        if sample.kind == zenoh.SampleKind.DELETE:
            raise Refused("expected a put; found a delete")
        if self.type_hash is not None:
            found = str(sample.key_expr).rpartition("/")[2]
            if found == NO_HASH:
                raise Refused(f"type hash {NO_HASH_TEXT}")
            if found != self.type_hash:
                raise Refused(hash_text(self.ros_type, found, self.type_hash))
        if len(sample.payload) > self.max_message:
            raise Refused(larger_than(self.max_message))
        return None if self.type_hash is None else read_attachment(sample.attachment)


class Refused(ReportedError):
    """A message that is not taken; one line that says why."""


def read_attachment(attachment: zenoh.ZBytes | None) -> Attachment:
    """Read what rmw_zenoh sends beside a message or request; raises BadAttachment."""
    if attachment is None:
        raise BadAttachment("expected an attachment of rmw_zenoh; found none: the sender is no ROS node")
    if len(attachment) > MAX_ATTACHMENT:
        raise BadAttachment(f"expected an attachment of rmw_zenoh; found more than {MAX_ATTACHMENT} bytes")
    return unpack_attachment(attachment.to_bytes())


def subscribe(session: zenoh.Session, key: str, qos: Qos, intake: Intake) -> Callable[[], object]:
    """Declare a subscriber; return what undeclares it. Raises WireError.

    With transient_local it gets a publisher's last messages too, whoever came first.
    """
    handler = zenoh.handlers.Callback(intake.take, indirect=False)
    with zenoh_errors(intake.topic):
        if not qos.transient_local:
            return session.declare_subscriber(key, handler).undeclare
        return zenoh.ext.declare_advanced_subscriber(
            session,
            key,
            handler,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth or ALL),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if qos.reliable else None,
            subscriber_detection=True,
        ).undeclare
