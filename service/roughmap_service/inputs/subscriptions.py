"""The subscribers and queryables through which messages of robots come in."""

import logging
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas import Keys, MessageFault, Refusal, check_encoding, encodings
from roughmap_schemas.kinds import Kind
from roughmap_service.host.counters import OTHERS, Counters
from roughmap_service.host.log_lines import note
from roughmap_service.inputs.queue import InputMessage, Intake
from roughmap_service.inputs.receipts import IngestReply, Replies

log = logging.getLogger(__name__)


MAX_NUMBERED = 10_000
"""Streams (a robot's messages of a kind) whose gaps are counted."""


MAX_TOLD = 500
"""Characters of a log line about a message: what it holds comes from outside."""


MAX_ATTACHMENT = 1 << 16
"""Bytes with a request, which are in memory until it is answered, and count nowhere."""


MAX_GAP = 1 << 32
"""A number that leaps further tells of no loss, but of another count."""


def refuse(counters: Counters, robot: str, fault: MessageFault) -> None:
    """Count a message that never reaches the log, and tell of it: a few lines a minute of each robot and reason."""
    shown = counters.refuse(fault.code, robot)
    if fault.code != Refusal.LOG_UNAVAILABLE:  # of which the log's own line tells
        of = "" if robot == OTHERS else f"robot {robot}: "
        text = f"{of}a message is refused, {fault.code}: {fault.message}"[:MAX_TOLD]
        note(log, logging.WARNING, "refused", text, robot=shown, reason=str(fault.code))


class ZenohInputs:
    """Subscribers and ingest queryables of one session, a context manager that undeclares them.

    Callbacks run in Zenoh's own threads (``indirect=False``): they check, copy the payload once and queue it. So there
    is one queue, ours, whose limit and drop policy are `Intake`'s; none of Zenoh's stands before it.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, intake: Intake, replies: Replies, max_message: int, counters: Counters
    ) -> None:
        self._keys = keys
        self._intake = intake
        self._replies = replies
        self._max_message = max_message
        self._counters = counters
        self._sequences: dict[tuple[str, Kind], int] = {}
        self._undeclare: list[Callable[[], object]] = []
        for kind, key, parse in (
            (Kind.POINTS, keys.points_any, keys.parse_points),
            (Kind.ODOMETRY, keys.odometry_any, keys.parse_odometry),
            (Kind.TRANSFORM, keys.transform_any, keys.parse_transform),
        ):
            handler = zenoh.handlers.Callback(self._sample_handler(kind, parse), indirect=False)
            self._undeclare.append(session.declare_subscriber(key, handler).undeclare)
        answer = zenoh.handlers.Callback(self._answer, indirect=False)
        for key in keys.ingest_any:
            self._undeclare.append(session.declare_queryable(key, answer, complete=True).undeclare)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for undeclare in self._undeclare:
            undeclare()

    def _sample_handler(self, kind: Kind, parse: Callable[[str], str]) -> Callable[[zenoh.Sample], None]:
        def handle(sample: zenoh.Sample) -> None:
            robot = OTHERS
            try:
                robot = parse(str(sample.key_expr))
                if sample.kind == zenoh.SampleKind.DELETE:
                    raise MessageFault(Refusal.BAD_MESSAGE, "expected a put, found a delete")
                self._count_gap(robot, kind, sample.attachment)
                self._check(kind, str(sample.encoding), sample.payload)
            except MessageFault as fault:
                refuse(self._counters, robot, fault)
                return
            payload = sample.payload.to_bytes()
            self._intake.put(InputMessage(kind, robot, payload, time.time_ns(), time.monotonic()))

        return handle

    def _answer(self, query: zenoh.Query) -> None:
        reply, robot = IngestReply(query, self._replies), OTHERS
        try:
            name, robot = self._keys.parse_ingest(str(query.key_expr))
            kind, payload = Kind(name), query.payload
            if payload is None:
                raise MessageFault(Refusal.BAD_MESSAGE, "expected the message as the request's payload, found none")
            self._check(kind, str(query.encoding or ""), payload)
            if query.attachment is not None and len(query.attachment) > MAX_ATTACHMENT:
                found = f"an attachment of {len(query.attachment)} bytes"
                raise MessageFault(Refusal.TOO_LARGE, f"expected at most {MAX_ATTACHMENT} bytes of it; found {found}")
        except MessageFault as fault:
            refuse(self._counters, robot, fault)
            reply.refuse(fault)
            return
        self._intake.put(InputMessage(kind, robot, payload.to_bytes(), time.time_ns(), time.monotonic(), reply))

    def _check(self, kind: Kind, encoding: str, payload: zenoh.ZBytes) -> None:
        check_encoding(encoding, ENCODINGS[kind])
        if len(payload) > self._max_message:
            raise MessageFault(
                Refusal.TOO_LARGE, f"the message has {len(payload)} bytes (input.max_message: {self._max_message})"
            )

    def _count_gap(self, robot: str, kind: Kind, attachment: zenoh.ZBytes | None) -> None:
        """Publishers number their messages in an 8-byte attachment; what is missing was lost on the way."""
        if attachment is None or len(attachment) != 8:
            return
        number = int.from_bytes(attachment.to_bytes(), "little")
        last = self._sequences.get((robot, kind))
        if last is not None and 1 < number - last <= MAX_GAP:
            missing = number - last - 1
            self._counters.gap(robot, missing)
            text = f"robot {robot}: {missing} {kind.value} messages are missing before number {number}"
            note(log, logging.WARNING, "gap", text, robot=robot, kind=kind.value, missing=missing)
        if last is not None or len(self._sequences) < MAX_NUMBERED:
            self._sequences[robot, kind] = number


ENCODINGS = {
    Kind.POINTS: encodings.POINT_CLOUD,
    Kind.ODOMETRY: encodings.ODOMETRY,
    Kind.TRANSFORM: encodings.FRAME_TRANSFORM,
}
