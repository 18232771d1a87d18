"""The queryables: queries arrive here, are admitted, planned, queued and answered."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas.messages import MapStatus, QueryRecord
from roughmap_schemas.sections import QueryConfig
from roughmap_service.answers.cells import plan_cells
from roughmap_service.answers.map_reader import MapReader
from roughmap_service.answers.operations import Forget, plan_control, plan_forget, plan_status
from roughmap_service.answers.plan import Plan
from roughmap_service.answers.question import Question
from roughmap_service.answers.queue import AnswerQueue
from roughmap_service.answers.region import plan_region
from roughmap_service.answers.tiles import TileQueries

CONTROL_PLACES = 4
"""Control queries that may wait: operators send them one by one, by hand."""

CLOSE_SECONDS = 2.0
"""Longest wait at shutdown for running answers and for refusals of waiting queries."""


@dataclass(frozen=True, slots=True)
class _Queryable:
    """A key, and how queries that arrive under it are handled."""

    key: str
    plan: Callable[[Question], Plan]
    queue: AnswerQueue
    record: Callable[[QueryRecord], None]


class Answers:
    """Answers queries on tiles, region, cells, status and control while it is entered.

    Zenoh's callbacks are serial, so they only admit, plan and queue; ``query.workers`` threads answer, each query from
    one state of the map. A reader that stalls blocks others on the same link, for 5 s at most.

    ``status`` returns the status message. ``control`` maps actions (``snapshot``, ``reset``) to functions that carry
    them out and return (sequence, epoch), ``forget`` erases tiles; they run in a thread of their own. ``record_query``
    takes the record of every tile, region and cells query.
    """

    def __init__(
        self,
        session: zenoh.Session,
        reader: MapReader,
        limits: QueryConfig,
        *,
        status: Callable[[], MapStatus],
        control: Mapping[str, Callable[[], tuple[int, int]]],
        forget: Forget,
        record_query: Callable[[QueryRecord], None],
    ) -> None:
        self._session = session
        self._reader = reader
        self._status = status
        self._control = control
        self._forget = forget
        self._record_query = record_query
        self._queue = AnswerQueue("answers", limits.workers, limits.queue_limit, limits.max_running_cells)
        self._control_queue = AnswerQueue("control", 1, CONTROL_PLACES, 1)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(self._queue)
        self._stack.enter_context(self._control_queue)
        for queryable in self._queryables():
            declared = self._session.declare_queryable(queryable.key, partial(_handle, queryable), complete=True)
            self._stack.callback(self._undeclare, declared)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def waiting(self) -> int:
        """Queries that wait for a worker."""
        return self._queue.waiting

    def close(self) -> None:
        """Refuse waiting and new queries (`shutting_down`) and let running ones finish.

        Takes at most 2 s in all: the final checkpoint, the snapshot and the log's end come after it.
        """
        until = time.monotonic() + CLOSE_SECONDS
        for queue in (self._queue, self._control_queue):
            queue.close(max(0.0, until - time.monotonic()))
        self._stack.close()

    def _queryables(self) -> Iterator[_Queryable]:
        """List every key that is answered. A new kind of query gets a line here and a module that plans it."""
        reader, keys, tiles = self._reader, self._reader.keys, TileQueries(self._reader)

        def of_map(key: str, plan: Callable[[Question], Plan]) -> _Queryable:
            return _Queryable(key, plan, self._queue, self._record_query)

        yield of_map(keys.tiles_any, lambda asked: tiles.plan(asked.key, asked.parameters))
        yield of_map(keys.region, lambda asked: plan_region(reader, asked.parameters))
        yield of_map(keys.cells, lambda asked: plan_cells(reader, asked.parameters, asked.payload))
        yield _Queryable(
            keys.status, lambda asked: plan_status(self._status, keys.status, asked.parameters), self._queue, _no_record
        )
        for action, act in self._control.items():
            yield self._control_queryable(keys.control(action), act)
        key = keys.control("forget")
        yield _Queryable(
            key,
            lambda asked: plan_forget(self._forget, reader.cell_size, key, asked.key, asked.parameters),
            self._control_queue,
            _no_record,
        )

    def _control_queryable(self, key: str, act: Callable[[], tuple[int, int]]) -> _Queryable:
        return _Queryable(
            key, lambda asked: plan_control(act, key, asked.key, asked.parameters), self._control_queue, _no_record
        )

    def _undeclare(self, queryable: zenoh.Queryable[None]) -> None:
        if not self._session.is_closed():
            queryable.undeclare()


def _no_record(record: QueryRecord) -> None:
    """Drop the record: the log keeps no status and control queries."""


def _handle(queryable: _Queryable, query: zenoh.Query) -> None:
    """Take one query from its arrival to a queue. Zenoh calls this for one query at a time."""
    question = Question(query, queryable.record)
    try:
        question.check_size()  # admit
        plan = queryable.plan(question)  # plan: parse, check, count cells; nothing is read yet
        queryable.queue.submit(plan.cells, partial(_answer, question, plan), question.refuse)
    except Exception as error:  # noqa: BLE001 - the edge: every query gets a reply
        question.refuse(error)


def _answer(question: Question, plan: Plan) -> None:
    """Answer one query, in a worker's thread."""
    try:
        with plan.read() as answer:  # read one state of the map
            for reply in answer.replies:  # draw
                question.send(reply)
    except Exception as error:  # noqa: BLE001 - the edge, as above
        question.refuse(error)
    else:
        question.done(answer.sequence)
