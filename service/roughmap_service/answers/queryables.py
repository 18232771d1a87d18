"""The queryables: what readers ask over Zenoh, admitted, answered, and told in the log."""

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zenoh

from roughmap_schemas.config import Config
from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.faults import Fault, QueryFault
from roughmap_schemas.keys import Keys
from roughmap_schemas.messages import ControlAnswer, MapStatus, QueryError, QueryRecord, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import MAX_PLACES_TEXT, parse_parameters
from roughmap_service.answers.cells import plan_cells
from roughmap_service.answers.emptied import Emptied
from roughmap_service.answers.queue import AnswerQueue
from roughmap_service.answers.tile_reply import Identity
from roughmap_service.answers.tiles import Outcome, Plan, Reader, Send
from roughmap_service.host.ending import ShuttingDown
from roughmap_service.run.view import View

LOG = logging.getLogger(__name__)

ERROR_ENCODING = json_encoding("QueryError")

CODES: tuple[tuple[type[Exception], QueryCode], ...] = (
    (MemoryError, QueryCode.TOO_LARGE),
    (ShuttingDown, QueryCode.SHUTTING_DOWN),
    (Exception, QueryCode.INTERNAL),
)
"""What an error that is no `Fault` means to the asker; the first that fits."""

MAX_TOLD = 2000
"""Characters of a selector that the log keeps: a well-formed one has fewer, and others may have megabytes."""

CONTROL_PLACES = 4
"""Operators' requests that may wait: they come one by one, by hand."""

CLOSE_SECONDS = 2.0
"""How long the end waits for answers under way and for those who are told that there will be none."""

Planner = Callable[["Question"], Plan]


class Question:
    """One query and what is told of it: every way to its end goes through `reply`/`fail`, then `end`, once."""

    def __init__(self, query: zenoh.Query) -> None:
        self.query = query
        self.key = str(query.key_expr)
        self.parameters = str(query.parameters)
        self.started = time.monotonic_ns()

    def send(self, key: str, payload: bytes, encoding: str, attachment: bytes | None = None) -> None:
        """One reply. Blocks while the asker doesn't read, for 5 s at most: then its link is closed."""
        self.query.reply(key, payload, encoding=encoding, attachment=attachment)

    def fail(self, error: Exception) -> str:
        """The one error reply; gives its code."""
        code, message = as_fault(error)
        if code == QueryCode.INTERNAL:
            LOG.error("a query could not be answered: %s?%s", self.key, self.parameters, exc_info=error)
        try:
            self.query.reply_err(model_bytes(QueryError(code=code, message=message)), encoding=ERROR_ENCODING)
        except zenoh.ZError as gone:
            LOG.info("an asker could not be told %s: %s", code, gone)
        return code

    def record(self, outcome: str, tiles: int, sequence: int) -> QueryRecord:
        """What the log keeps of it."""
        selector = f"{self.key}?{self.parameters}" if self.parameters else self.key
        duration_ns = time.monotonic_ns() - self.started
        return QueryRecord(
            selector=selector[:MAX_TOLD], tiles=tiles, sequence=sequence, duration_ns=duration_ns, outcome=outcome
        )


def as_fault(error: Exception) -> tuple[str, str]:
    """Code and message for any error."""
    if isinstance(error, Fault):
        return error.code, error.message
    code = next(code for kind, code in CODES if isinstance(error, kind))
    return code, f"{type(error).__name__}: {error}"


class Answers:
    """Answers queries on tiles, region, cells, status and control while it is entered.

    Callbacks of Zenoh are serial, so they only parse, check and queue; ``query.workers`` threads answer, each query
    from one frozen map.

    A reader that stalls holds up what shares its link, for 5 s at most.

    ``status`` gives the status message; ``control`` maps actions (``snapshot``, ``reset``) to what carries them out and
    gives (sequence, epoch), in a thread of its own; ``record_query`` is told of every tile, region and cells query.
    """

    def __init__(
        self,
        session: zenoh.Session,
        view: View,
        keys: Keys,
        config: Config,
        identity: Identity,
        *,
        status: Callable[[], MapStatus],
        control: Mapping[str, Callable[[], tuple[int, int]]],
        record_query: Callable[[QueryRecord], None],
        emptied: Emptied,
    ) -> None:
        self._session = session
        self._keys = keys
        self._status = status
        self._control = control
        self._record_query = record_query
        self._reader = Reader(view, keys, config, identity, emptied)
        limits = config.query
        self._queue = AnswerQueue("answers", limits.workers, limits.queue_limit, limits.max_running_cells)
        self._operations = AnswerQueue("control", 1, CONTROL_PLACES, 1)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        self._stack.enter_context(self._queue)
        self._stack.enter_context(self._operations)
        reader, keys = self._reader, self._keys
        planners: dict[str, Planner] = {
            keys.tiles_any: lambda asked: reader.tiles(asked.key, asked.parameters),
            keys.region: lambda asked: reader.region(asked.parameters),
            keys.cells: lambda asked: plan_cells(reader, asked.parameters, asked.query.payload),
        }
        for key, plan in planners.items():
            self._declare(key, self._handler(self._queue, plan, told=True))
        self._declare(keys.status, self._handler(self._queue, self._plan_status, told=False))
        for action in self._control:
            self._declare(keys.control(action), self._handler(self._operations, self._planner(action), told=False))
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
        """End: what waits and what still comes is answered `shutting_down`, what runs goes on; 2 s for all of it
        together, since the final checkpoint, the snapshot and the log's end come after this."""
        until = time.monotonic() + CLOSE_SECONDS
        for queue in (self._queue, self._operations):
            queue.close(max(0.0, until - time.monotonic()))
        self._stack.close()

    def _declare(self, key: str, handler: Callable[[zenoh.Query], None]) -> None:
        queryable = self._session.declare_queryable(key, handler, complete=True)
        self._stack.callback(self._undeclare, queryable)

    def _undeclare(self, queryable: zenoh.Queryable[None]) -> None:
        if not self._session.is_closed():
            queryable.undeclare()

    def _handler(self, queue: AnswerQueue, plan: Planner, told: bool) -> Callable[[zenoh.Query], None]:
        """The callback of one queryable: admit, or say at once why not."""

        def end(question: Question, outcome: str, done: Outcome) -> None:
            question.query.drop()
            if told:
                self._record_query(question.record(outcome, done.tiles, done.sequence))

        def refuse(question: Question, error: Exception) -> None:
            end(question, question.fail(error), Outcome(0, 0))

        def run(question: Question, planned: Plan) -> None:
            try:
                done = planned.answer(question.send)
            except Exception as error:  # noqa: BLE001 - the edge: whatever it was, the asker is told
                refuse(question, error)
            else:
                end(question, "ok", done)

        def handle(query: zenoh.Query) -> None:
            question = Question(query)
            try:
                _check_size(query)
                planned = plan(question)
                queue.submit(planned.cells, lambda: run(question, planned), lambda fault: refuse(question, fault))
            except Exception as error:  # noqa: BLE001 - the edge, as above
                refuse(question, error)

        return handle

    def _plan_status(self, asked: Question) -> Plan:
        _no_parameters(asked.parameters)
        key, encoding = self._keys.status, json_encoding("MapStatus")

        def answer(send: Send) -> Outcome:
            status = self._status()
            send(key, model_bytes(status), encoding)
            return Outcome(1, status.sequence)

        return Plan(0, answer)

    def _planner(self, action: str) -> Planner:
        key, encoding = self._keys.control(action), json_encoding("ControlAnswer")
        act = self._control[action]

        def answer(send: Send) -> Outcome:
            sequence, epoch = act()
            send(key, model_bytes(ControlAnswer(sequence=sequence, epoch=epoch)), encoding)
            return Outcome(1, sequence)

        def plan(asked: Question) -> Plan:
            _no_parameters(asked.parameters)
            if asked.key != key:  # nobody who looks around with ** means to empty the map
                raise QueryFault(QueryCode.BAD_KEY, f"expected {key} without wildcards; found {asked.key[:200]!r}")
            return Plan(0, answer)

        return plan


def _check_size(query: zenoh.Query) -> None:
    """What comes with a question is in memory until it is answered, whether anybody wants it or not."""
    for what, sent in (("payload", query.payload), ("attachment", query.attachment)):
        if sent is not None and len(sent) > MAX_PLACES_TEXT:
            raise QueryFault(
                QueryCode.TOO_LARGE, f"{what}: expected at most {MAX_PLACES_TEXT} bytes; found {len(sent)}"
            )


def _no_parameters(text: str) -> None:
    for name in parse_parameters(text):
        raise QueryFault(QueryCode.UNKNOWN_PARAMETER, f"{name[:80]!r}: expected no parameters")
