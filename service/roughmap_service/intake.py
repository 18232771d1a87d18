"""From Zenoh's threads to the sequencer: what is let in, and what is dropped when too much comes."""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas import Keys, MessageFault, Refusal, check_encoding, encodings

from .counters import OTHERS, Counters
from .ingest import Duplicates, Identity, IngestReply, Replies
from .log_file import Kind
from .logs import note

log = logging.getLogger(__name__)

LEAST_COST = 256
"""Bytes that a queued cloud counts for at least: an empty one costs memory too."""

MAX_NUMBERED = 10_000
"""Streams (a robot's messages of a kind) whose gaps are counted."""

MAX_TOLD = 500
"""Characters of a log line about a message: what it holds comes from outside."""

MAX_ATTACHMENT = 1 << 16
"""Bytes with a request, which are in memory until it is answered, and count nowhere."""

MAX_GAP = 1 << 32
"""A number that leaps further tells of no loss, but of another count."""


@dataclass(slots=True)
class InputMessage:
    """An input that passed the checks on its key, encoding and size, not yet decoded."""

    kind: Kind
    robot: str
    payload: bytes
    received_ns: int
    arrival: float
    reply: IngestReply | None = None
    identity: Identity = field(init=False)
    """What tells it from others. Made by Zenoh's thread, which has the bytes at hand: the sequencer would wait for them
    as long as for a seventh of the cloud's integration."""

    def __post_init__(self) -> None:
        self.identity = Duplicates.identity(self.robot, self.kind, self.payload)


Command = Callable[[], None]
"""Something that is to be done between two inputs, in the sequencer's thread."""


TURN_MESSAGES = 512
"""So many messages are taken at a time, of each robot as many as of the others, if more are there: what one floods with
holds up nobody else for longer than these take, a tenth of a second."""


@dataclass
class _Held:
    """What one robot has queued, by number; bytes of its clouds; numbers of its published clouds and of its poses."""

    items: dict[int, InputMessage] = field(default_factory=dict)
    size: int = 0
    clouds: deque[int] = field(default_factory=deque)
    poses: deque[int] = field(default_factory=deque)

    def take(self, most: int) -> list[tuple[int, InputMessage]]:
        """The first ``most``, taken out."""
        taken = list(islice(self.items.items(), most))
        for number, message in taken:
            del self.items[number]
            if message.kind is Kind.POINTS:
                self.size -= _cost(message)
            for numbers in (self.clouds, self.poses):
                if numbers and numbers[0] == number:
                    numbers.popleft()
        return taken


@dataclass
class Intake:
    """A bounded queue, so that whoever floods it drops what is its own.

    When clouds fill it, the oldest published one of the robot that holds most is dropped, and an ingested one is
    answered ``busy`` instead; when poses and transforms do, the newest of the robot that holds most of these. No pose
    is ever dropped for a cloud's sake.
    """

    limit: int
    counters: Counters
    pose_limit: int = 10_000
    _commands: deque[Command] = field(default_factory=deque)
    _robots: dict[str, _Held] = field(default_factory=dict)
    _number: int = 0
    _wake: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False

    @property
    def held(self) -> int:
        """Bytes of the clouds that are queued."""
        with self._wake:
            return self._size()

    def put(self, message: InputMessage) -> None:
        """Queue a message, or drop one and count it."""
        with self._wake:
            dropped = self._admit(message)
            self._wake.notify()
        for refused in dropped:
            code = Refusal.SHUTTING_DOWN if self.closed else Refusal.BUSY
            self.counters.refuse(code)
            if refused.reply is not None:
                refused.reply.refuse(MessageFault(code, "the service is ending" if self.closed else "try again"))

    def command(self, command: Command) -> None:
        """Queue something to be done in the sequencer's thread."""
        with self._wake:
            self._commands.append(command)
            self._wake.notify()

    def take(self, timeout: float) -> tuple[list[InputMessage], list[Command], float]:
        """What is queued, at most `TURN_MESSAGES`, after waiting at most ``timeout`` s for something; and the monotonic
        time up to which all that arrived has been taken."""
        with self._wake:
            self._wake.wait_for(lambda: self._robots or self._commands or self.closed, timeout)
            commands = list(self._commands)
            self._commands.clear()
            share = max(TURN_MESSAGES, sum(len(held.items) for held in self._robots.values()))
            if share > TURN_MESSAGES:
                share = TURN_MESSAGES // len(self._robots) or 1
            taken = sorted(item for held in self._robots.values() for item in held.take(share))
            self._robots = {robot: held for robot, held in self._robots.items() if held.items}
            left = [next(iter(held.items.values())).arrival for held in self._robots.values()]
            return [message for _, message in taken], commands, min(left, default=time.monotonic())

    def close(self) -> None:
        """Let nothing more in; what is queued can still be taken."""
        with self._wake:
            self.closed = True
            self._wake.notify()

    def _admit(self, message: InputMessage) -> list[InputMessage]:
        """Take the message in; returns those that had to go."""
        if self.closed:
            return [message]
        if message.kind is not Kind.POINTS:
            self._queue(message).poses.append(self._number)
            if sum(len(held.poses) for held in self._robots.values()) <= self.pose_limit:
                return []
            held = max(self._robots.values(), key=lambda held: len(held.poses))
            return [held.items.pop(held.poses.pop())]
        dropped: list[InputMessage] = []
        while self._size() + _cost(message) > self.limit and self._size():
            oldest = None if message.reply is not None else self._drop_of_the_largest()
            if oldest is None:
                return [*dropped, message]
            dropped.append(oldest)
        held = self._queue(message)
        held.size += _cost(message)
        if message.reply is None:
            held.clouds.append(self._number)
        return dropped

    def _size(self) -> int:
        return sum(held.size for held in self._robots.values())

    def _queue(self, message: InputMessage) -> _Held:
        self._number += 1
        held = self._robots.setdefault(message.robot, _Held())
        held.items[self._number] = message
        return held

    def _drop_of_the_largest(self) -> InputMessage | None:
        """The oldest published cloud of the robot that holds most, taken out; None where all are ingested ones."""
        held = max((held for held in self._robots.values() if held.clouds), key=lambda held: held.size, default=None)
        if held is None:
            return None
        oldest = held.items.pop(held.clouds.popleft())
        held.size -= _cost(oldest)
        return oldest


def _cost(message: InputMessage) -> int:
    return max(len(message.payload), LEAST_COST)


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
