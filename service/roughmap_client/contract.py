"""JSON replies, read only if they are in a version of the contract that this client speaks.

Every reply names its version, so the check needs no query of its own, covers updates and receipts as well as answers,
and notices a service that was upgraded or downgraded under a running client.
"""

import json
from typing import TypeVar

from roughmap_client.errors import ContractMismatch
from roughmap_schemas import BadJson, parse_model
from roughmap_schemas.contract import CONTRACT_VERSION, is_compatible, major
from roughmap_schemas.messages import Reply

R = TypeVar("R", bound=Reply)


def read_reply(kind: type[R], payload: bytes) -> R:
    """Read a reply; raises ``ContractMismatch``, or ``BadJson`` if it is not a ``kind``."""
    try:
        reply = parse_model(kind, payload)
    except BadJson:
        # Another major may have other members: its version is the better explanation.
        named = _named_version(payload)
        if named is not None:
            _check(named)
        raise
    # The model fills in a missing version, which only a service older than the field leaves out.
    _check(reply.contract if "contract" in reply.model_fields_set else None)
    return reply


def _check(version: str | None) -> None:
    if version is None:
        raise ContractMismatch(
            f"the service names no contract version, so it is older than {CONTRACT_VERSION}; upgrade the service"
        )
    if not is_compatible(version):
        raise ContractMismatch(
            f"the service speaks contract {version[:20]}, this client speaks {major(CONTRACT_VERSION)}.x; "
            "install the same release of roughmap on both sides"
        )


def _named_version(payload: bytes) -> str | None:
    try:
        value = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    version = value.get("contract") if isinstance(value, dict) else None
    return version if isinstance(version, str) else None
