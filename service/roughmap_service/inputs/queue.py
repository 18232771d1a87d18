"""The input queue, from Zenoh's threads to the sequencer: bounded, and fair between robots."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import islice

from roughmap_schemas import MessageFault, Refusal
from roughmap_schemas.kinds import Kind
from roughmap_service.host.counters import Counters
from roughmap_service.inputs.receipts import IngestReply
from roughmap_service.run.duplicates import Duplicates, Identity

LEAST_COST = 256
"""Bytes that a queued cloud counts for at least: an empty cloud costs memory too."""

MAX_POSES = 10_000
"""Most poses and transforms in the queue, of all robots: several seconds of a fleet's, a few MB."""

TURN_MESSAGES = 512
"""Messages that the sequencer takes at a time. If more are queued, each robot gets an equal share: a flood from one
holds up the others for no longer than these messages take, a tenth of a second."""


COMPANY = 8
"""Poses that end a wait for company. A cloud that comes then has no more before it: a fraction of a millisecond."""


@dataclass(slots=True)
class InputMessage:
    """A message that passed the checks on its key, encoding and size; not yet decoded.

    ``received_ns`` is wall time, ``arrival`` monotonic s. ``reply`` is set if the message was ingested.
    """

    kind: Kind
    robot: str
    payload: bytes
    received_ns: int
    arrival: float
    reply: IngestReply | None = None
    identity: Identity = field(init=False)
    """Robot, kind and hash of the bytes. Computed here, in Zenoh's thread, which has the bytes in its cache; in the
    sequencer it would take a seventh of the cloud's integration."""

    def __post_init__(self) -> None:
        self.identity = Duplicates.identity(self.robot, self.kind, self.payload)


Command = Callable[[], None]
"""A function to run between two messages, in the sequencer's thread."""


@dataclass
class _Held:
    """One robot's queued messages by number, bytes of its clouds, numbers of its published clouds and of its poses."""

    items: dict[int, InputMessage] = field(default_factory=dict)
    size: int = 0
    clouds: deque[int] = field(default_factory=deque)
    poses: deque[int] = field(default_factory=deque)

    def take(self, most: int) -> list[tuple[int, InputMessage]]:
        """Remove and return the first ``most``."""
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
class InputQueue:
    """A bounded queue. A robot that floods it loses its own messages.

    Past ``limit`` bytes of clouds the oldest published cloud of the robot with most bytes is dropped; an ingested one
    is refused as ``busy`` instead. Past `MAX_POSES` poses and transforms the newest of the robot with most of them is
    dropped. No pose is ever dropped for a cloud.
    """

    limit: int
    counters: Counters
    _commands: deque[Command] = field(default_factory=deque)
    _robots: dict[str, _Held] = field(default_factory=dict)
    _number: int = 0
    _pressing: bool = False
    _wake: threading.Condition = field(default_factory=threading.Condition)
    closed: bool = False

    @property
    def held(self) -> int:
        """Bytes of the queued clouds."""
        with self._wake:
            return self._size()

    def put(self, message: InputMessage) -> None:
        """Queue a message, or drop one and count it."""
        with self._wake:
            first = not self._robots
            dropped = self._admit(message)
            self._pressing |= message.kind is Kind.POINTS or message.reply is not None
            if first or self._is_pressing():
                self._wake.notify()
        for refused in dropped:
            code = Refusal.SHUTTING_DOWN if self.closed else Refusal.BUSY
            self.counters.refuse(code)
            if refused.reply is not None:
                refused.reply.refuse(MessageFault(code, "the service is ending" if self.closed else "try again"))

    def command(self, command: Command) -> None:
        """Queue a function that the sequencer's thread is to run."""
        with self._wake:
            self._commands.append(command)
            self._wake.notify()

    def take(self, timeout: float, patience: float = 0.0) -> tuple[list[InputMessage], list[Command], float]:
        """Take at most `TURN_MESSAGES` messages and all commands, after waiting at most ``timeout`` s for any.

        Poses and transforms wait for company, ``patience`` s at most: waking for each costs more than taking it. A
        cloud, an ingested message and a command end the wait. Also returns the monotonic time before which all messages
        that arrived have been taken.
        """
        with self._wake:
            if self._wake.wait_for(lambda: self._robots or self._commands or self.closed, timeout):
                self._wake.wait_for(self._is_pressing, min(timeout, patience))
            commands = list(self._commands)
            self._commands.clear()
            share = max(TURN_MESSAGES, sum(len(held.items) for held in self._robots.values()))
            if share > TURN_MESSAGES:
                share = TURN_MESSAGES // len(self._robots) or 1
            taken = sorted(item for held in self._robots.values() for item in held.take(share))
            self._robots = {robot: held for robot, held in self._robots.items() if held.items}
            self._pressing = bool(self._robots)
            left = [next(iter(held.items.values())).arrival for held in self._robots.values()]
            return [message for _, message in taken], commands, min(left, default=time.monotonic())

    def close(self) -> None:
        """Refuse further messages; queued ones can still be taken."""
        with self._wake:
            self.closed = True
            self._wake.notify()

    def _is_pressing(self) -> bool:
        """Whether there is something that should not wait for company."""
        if self._pressing or self._commands or self.closed:
            return True
        robots = self._robots
        return len(robots) >= COMPANY or sum(len(held.items) for held in robots.values()) >= COMPANY

    def _admit(self, message: InputMessage) -> list[InputMessage]:
        """Queue the message. Return the messages that are dropped or refused for it."""
        if self.closed:
            return [message]
        if message.kind is not Kind.POINTS:
            self._queue(message).poses.append(self._number)
            if sum(len(held.poses) for held in self._robots.values()) <= MAX_POSES:
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
        """Remove the oldest published cloud of the robot with most bytes; None if all clouds are ingested ones."""
        held = max((held for held in self._robots.values() if held.clouds), key=lambda held: held.size, default=None)
        if held is None:
            return None
        oldest = held.items.pop(held.clouds.popleft())
        held.size -= _cost(oldest)
        return oldest


def _cost(message: InputMessage) -> int:
    return max(len(message.payload), LEAST_COST)
