"""Messages that the run has already logged, so that one sent twice counts once."""

from collections import OrderedDict
from collections.abc import Iterable

import xxhash

from roughmap_schemas.kinds import Kind

Identity = tuple[str, str, str]
"""Robot, kind and hash of a message."""


class Duplicates:
    """The last messages by robot, kind and the 128-bit hash of their bytes, each with its input number.

    Past the limit the oldest message of the robot with most of them is forgotten, so that a flood from one robot does
    not push out the messages of others.
    """

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._number = 0
        self._seen: dict[str, OrderedDict[Identity, int]] = {}

    @staticmethod
    def identity(robot: str, kind: Kind, payload: bytes) -> Identity:
        """Return what two equal messages have in common."""
        return robot, kind.value, xxhash.xxh3_128_hexdigest(payload)

    def find(self, identity: Identity) -> int | None:
        """Return the message's input number; None if it is not among the last ones."""
        of = self._seen.get(identity[0])
        return None if of is None else of.get(identity)

    def add(self, identity: Identity, number: int) -> None:
        """Remember a message as the newest. Past the limit, forget one."""
        of = self._seen.setdefault(identity[0], OrderedDict())
        self._number += of.pop(identity, None) is None
        of[identity] = number
        while self._number > self._limit:
            max(self._seen.values(), key=len).popitem(last=False)
            self._number -= 1

    def clear(self) -> None:
        """Forget all messages."""
        self._seen.clear()
        self._number = 0

    def to_state(self) -> list[tuple[str, str, str, int]]:
        """Return all messages, oldest first."""
        seen = [(*identity, number) for of in self._seen.values() for identity, number in of.items()]
        return sorted(seen, key=lambda one: one[3])

    def load_state(self, state: Iterable[tuple[str, str, str, int]]) -> None:
        """Restore what `to_state` returned."""
        for robot, kind, digest, number in state:
            self.add((robot, kind, digest), number)
