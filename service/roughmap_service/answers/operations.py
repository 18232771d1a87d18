"""Queries that read no tiles: the status, and the control actions ``snapshot``, ``reset`` and ``forget``."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from roughmap.tiles.index import TileBox
from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.messages import ControlAnswer, MapStatus, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import ForgetQuery, parse_parameters
from roughmap_service.answers.plan import Answer, Plan, Reply
from roughmap_service.answers.tile_selection import selected_box

Forget = Callable[[TileBox | None, float | None, str], tuple[int, int, int]]
"""Erases the tiles in a box (None: anywhere) without a point for that many seconds (None: any age); the text says why.
Returns (sequence, epoch) after that, and the number of tiles."""

STATUS_ENCODING = json_encoding("MapStatus")
CONTROL_ENCODING = json_encoding("ControlAnswer")


def plan_status(status: Callable[[], MapStatus], key: str, parameters: str) -> Plan:
    """Return the plan of a status query; ``key`` is the key to reply under."""
    _expect_no_parameters(parameters)

    def read() -> AbstractContextManager[Answer]:
        found = status()
        return nullcontext(Answer(found.sequence, [Reply(key, model_bytes(found), STATUS_ENCODING)]))

    return Plan(0, read)


def plan_control(act: Callable[[], tuple[int, int]], key: str, asked_key: str, parameters: str) -> Plan:
    """Return the plan of a control query: ``act`` carries it out and returns (sequence, epoch).

    ``asked_key`` must be ``key`` itself: a query with ``**`` must never reset the map.
    """
    _expect_key(key, asked_key)
    _expect_no_parameters(parameters)

    def carry_out() -> ControlAnswer:
        sequence, epoch = act()
        return ControlAnswer(sequence=sequence, epoch=epoch)

    return _plan_action(carry_out, key)


def plan_forget(forget: Forget, cell_size: float, key: str, asked_key: str, parameters: str) -> Plan:
    """Return the plan of a query that erases tiles; ``asked_key`` as for `plan_control`."""
    _expect_key(key, asked_key)
    asked = ForgetQuery.parse(parameters)

    def carry_out() -> ControlAnswer:
        box = selected_box(None, None, asked.bbox, cell_size)
        sequence, epoch, tiles = forget(box, asked.older, f"an operator's request ({asked.format()})")
        return ControlAnswer(sequence=sequence, epoch=epoch, tiles=tiles)

    return _plan_action(carry_out, key)


def _plan_action(carry_out: Callable[[], ControlAnswer], key: str) -> Plan:
    def read() -> AbstractContextManager[Answer]:
        answer = carry_out()
        return nullcontext(Answer(answer.sequence, [Reply(key, model_bytes(answer), CONTROL_ENCODING)]))

    return Plan(0, read)


def _expect_key(key: str, asked_key: str) -> None:
    if asked_key != key:
        raise QueryFault(QueryCode.BAD_KEY, f"expected {key} without wildcards; found {asked_key[:200]!r}")


def _expect_no_parameters(text: str) -> None:
    for name in parse_parameters(text):
        raise QueryFault(QueryCode.UNKNOWN_PARAMETER, f"expected no parameters; found {name[:80]!r}")
