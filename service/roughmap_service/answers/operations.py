"""Queries that read no tiles: the status, and the control actions ``snapshot`` and ``reset``."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from roughmap_schemas.encodings import json_encoding
from roughmap_schemas.faults import QueryFault
from roughmap_schemas.messages import ControlAnswer, MapStatus, model_bytes
from roughmap_schemas.reasons import QueryCode
from roughmap_schemas.selectors import parse_parameters
from roughmap_service.answers.plan import Answer, Plan, Reply

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
    _expect_no_parameters(parameters)
    if asked_key != key:
        raise QueryFault(QueryCode.BAD_KEY, f"expected {key} without wildcards; found {asked_key[:200]!r}")

    def read() -> AbstractContextManager[Answer]:
        sequence, epoch = act()
        payload = model_bytes(ControlAnswer(sequence=sequence, epoch=epoch))
        return nullcontext(Answer(sequence, [Reply(key, payload, CONTROL_ENCODING)]))

    return Plan(0, read)


def _expect_no_parameters(text: str) -> None:
    for name in parse_parameters(text):
        raise QueryFault(QueryCode.UNKNOWN_PARAMETER, f"expected no parameters; found {name[:80]!r}")
