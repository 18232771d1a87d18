"""Subscribers and ingest queryables: messages come in from Zenoh."""

import logging
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas import Keys, MessageFault, Refusal, check_encoding, encodings
from roughmap_schemas.kinds import Kind
from roughmap_service.host.counters import OTHERS, Counters
from roughmap_service.inputs.admission import refuse
from roughmap_service.inputs.gaps import Gaps
from roughmap_service.inputs.queue import InputMessage, InputQueue
from roughmap_service.inputs.receipts import IngestReply, ReceiptSender
from roughmap_service.inputs.streams import Streams

logger = logging.getLogger(__name__)

MAX_ATTACHMENT = 1 << 16
"""Bytes of an ingest request's attachment. It stays in memory until the answer, and no limit counts it."""


class ZenohInputs:
    """Subscribers and ingest queryables of one session; a context manager that undeclares them.

    Callbacks run in Zenoh's threads (``indirect=False``): they check, copy the payload once and queue it. So Zenoh
    queues nothing, and the input queue's limit and drop policy apply.
    """

    def __init__(
        self,
        session: zenoh.Session,
        keys: Keys,
        queue: InputQueue,
        receipts: ReceiptSender,
        max_message: int,
        counters: Counters,
        streams: Streams,
    ) -> None:
        self._keys = keys
        self._queue = queue
        self._receipts = receipts
        self._max_message = max_message
        self._counters = counters
        self._streams = streams
        self._gaps = Gaps()
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
                self._count_lost(robot, kind, sample)
                self._check(kind, str(sample.encoding), sample.payload)
            except MessageFault as fault:
                refuse(self._counters, self._streams, robot, kind, fault)
                return
            payload = sample.payload.to_bytes()
            self._queue.put(InputMessage(kind, robot, payload, time.time_ns(), time.monotonic()))

        return handle

    def _answer(self, query: zenoh.Query) -> None:
        reply, robot, kind = IngestReply(query, self._receipts), OTHERS, Kind.POINTS
        try:
            name, robot = self._keys.parse_ingest(str(query.key_expr))
            kind, payload = Kind(name), query.payload
            if payload is None:
                raise MessageFault(Refusal.BAD_MESSAGE, "expected the message as the request's payload, found none")
            self._check(kind, str(query.encoding or ""), payload)
            if query.attachment is not None and len(query.attachment) > MAX_ATTACHMENT:
                found = len(query.attachment)
                raise MessageFault(
                    Refusal.TOO_LARGE, f"attachment: expected at most {MAX_ATTACHMENT} bytes; found {found}"
                )
        except MessageFault as fault:
            refuse(self._counters, self._streams, robot, kind, fault)
            reply.refuse(fault)
            return
        self._queue.put(InputMessage(kind, robot, payload.to_bytes(), time.time_ns(), time.monotonic(), reply))

    def _check(self, kind: Kind, encoding: str, payload: zenoh.ZBytes) -> None:
        check_encoding(encoding, ENCODINGS[kind])
        if len(payload) > self._max_message:
            raise MessageFault(
                Refusal.TOO_LARGE, f"the message has {len(payload)} bytes (input.max_message: {self._max_message})"
            )

    def _count_lost(self, robot: str, kind: Kind, sample: zenoh.Sample) -> None:
        """Count messages lost on the way, by Zenoh's numbers or those in an 8-byte attachment."""
        attachment = sample.attachment
        source = getattr(sample, "source_info", None)  # Zenoh marks it as unstable
        if source is not None:
            lost = self._gaps.sourced(str(sample.key_expr), str(source.source_id), source.source_sn)
        elif attachment is not None and len(attachment) == 8:
            lost = self._gaps.numbered(robot, kind, int.from_bytes(attachment.to_bytes(), "little"))
        else:
            return
        if lost:
            self._counters.gap(robot, lost)
            self._streams.gap(robot, kind.value, lost)


ENCODINGS = {
    Kind.POINTS: encodings.POINT_CLOUD,
    Kind.ODOMETRY: encodings.ODOMETRY,
    Kind.TRANSFORM: encodings.FRAME_TRANSFORM,
}
