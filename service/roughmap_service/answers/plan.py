"""What a query becomes: a plan first, then an answer of replies. Nothing here depends on Zenoh."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import NamedTuple

from roughmap.cell import TILE_CELLS

TILE_AREA = TILE_CELLS * TILE_CELLS
"""Cells of one tile."""

INT32 = 2**31
"""Cell numbers lie in -INT32 .. INT32 - 1."""


class Reply(NamedTuple):
    """One reply to a query."""

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """All replies to one query, and the sequence of the map that they show.

    ``replies`` may draw each reply when it is iterated. It raises QueryFault before the first reply or never.
    """

    sequence: int
    replies: Iterable[Reply]


@dataclass(frozen=True, slots=True)
class Plan:
    """A checked query that has not read the map yet.

    ``cells`` is the most cells that the answer may read. ``read`` opens the answer; what it holds of the map is
    released when the context ends. ``read`` may raise QueryFault.
    """

    cells: int
    read: Callable[[], AbstractContextManager[Answer]]
