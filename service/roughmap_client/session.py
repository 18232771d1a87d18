"""The client's Zenoh session, and one query with a time limit: its replies, its errors, and how it ended."""

import json
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import zenoh

from roughmap_client.access import endpoints_of, read_zenoh_file, zenoh_message
from roughmap_client.contract import read_reply
from roughmap_client.errors import (
    BadArgument,
    IncompleteAnswer,
    MixedInstances,
    NoAnswer,
    QueryRefused,
    UnreadableAnswer,
    short_message,
)
from roughmap_schemas.config import without_secrets
from roughmap_schemas.encodings import UNSAID
from roughmap_schemas.faults import ConfigFault
from roughmap_schemas.messages import BadJson, QueryError

ZENOH_TIMEOUT = b"Timeout"
"""Zenoh's own error at the time limit; a service's errors are JSON. It comes either from the session, without a replier
id, or from the session's routing part, with one."""

GRACE_S = 1.0
"""How long past the time limit Zenoh may take to end a query."""


@dataclass(frozen=True, slots=True)
class Part:
    """One reply: key, payload, attachment, encoding, and the Zenoh entity that sent it."""

    key: str
    payload: bytes
    attachment: bytes
    encoding: str
    replier: str

    def check_encoding(self, expected: str) -> None:
        """Raise ``UnreadableAnswer`` unless the encoding is ``expected`` or unset."""
        if self.encoding not in UNSAID and self.encoding != expected:
            raise UnreadableAnswer(f"{self.key}: expected encoding {expected}; found {self.encoding[:200]!r}")


@dataclass(slots=True)
class Answer:
    """All replies and errors to one query, in the order of arrival."""

    parts: list[Part] = field(default_factory=list)
    errors: list[tuple[bytes, str]] = field(default_factory=list)
    timed_out: bool = False

    def whole(self) -> list[Part]:
        """Return the replies; raises ``QueryRefused`` for an error, ``IncompleteAnswer`` or ``NoAnswer`` at a time-out.

        An empty list means that nothing matches, or that no service is reachable.
        """
        for payload, encoding in self.errors:
            try:
                error = read_reply(QueryError, payload)
            except BadJson:
                raise UnreadableAnswer(
                    f"expected a QueryError; found {payload[:200]!r}, encoding {encoding!r}"
                ) from None
            raise QueryRefused(error.code, error.message)
        if self.timed_out and self.parts:
            raise IncompleteAnswer(f"timed out after {len(self.parts)} replies")
        if self.timed_out:
            raise NoAnswer("no reply came within the time limit")
        return self.parts

    def single(self) -> Part:
        """Return the only reply; also raises ``MixedInstances`` for several and ``NoAnswer`` for none."""
        parts = self.whole()
        if not parts:
            raise NoAnswer("no service answers on these keys")
        if len(parts) > 1:
            raise MixedInstances(f"{len(parts)} services answered on {parts[0].key}")
        return parts[0]


def ask(
    session: zenoh.Session,
    selector: str,
    *,
    timeout: float,
    payload: bytes | None = None,
    encoding: str | None = None,
    single: bool = False,
) -> Answer:
    """Send a query and wait at most ``timeout`` seconds for its last reply.

    A ``single`` answer also ends at a second reply, which makes both useless. Consolidation is NONE, so replies come as
    they are sent. The callback only copies and appends, so that Zenoh's queue before it stays short however many tiles
    come. Raises NoAnswer if the session is closed.
    """
    answer = Answer()
    ended = threading.Event()
    lock = threading.Lock()

    def take(reply: zenoh.Reply) -> None:
        sample, error = reply.ok, reply.err
        with lock:
            if ended.is_set():
                return
            if sample is not None:
                attachment = sample.attachment
                answer.parts.append(
                    Part(
                        key=str(sample.key_expr),
                        payload=sample.payload.to_bytes(),
                        attachment=b"" if attachment is None else attachment.to_bytes(),
                        encoding=str(sample.encoding),
                        replier=str(reply.replier_id),
                    )
                )
                if single and len(answer.parts) > 1:
                    ended.set()
            elif error is not None:
                payload = error.payload.to_bytes()
                if reply.replier_id is None or payload == ZENOH_TIMEOUT:
                    answer.timed_out = True
                else:
                    answer.errors.append((payload, str(error.encoding)))

    try:
        session.get(
            selector,
            zenoh.handlers.Callback(take, ended.set),
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=timeout,
            payload=payload,
            encoding=encoding,
        )
    except zenoh.ZError as error:
        raise NoAnswer(f"query {selector[:200]} failed: {short_message(error)}") from None
    if not ended.wait(timeout + GRACE_S):
        with lock:
            ended.set()
            answer.timed_out = True
    return answer


def open_session(
    connect: Sequence[str], timeout: float, config: zenoh.Config | str | Path | None = None
) -> zenoh.Session:
    """Open a client session to the first endpoint that answers; it reconnects by itself.

    ``config`` is a Zenoh configuration, or a file with one, to which the rest is added. Raises BadArgument for an
    invalid file, NoAnswer if no connection comes about.
    """
    try:
        chosen = read_zenoh_file(config, "config") if isinstance(config, str | Path) else config or zenoh.Config()
    except ConfigFault as fault:
        raise BadArgument(str(fault)) from None
    settings: dict[str, object] = {"mode": "client", "connect/timeout_ms": int(timeout * 1000)}
    if connect or config is None:
        settings |= {"connect/endpoints": list(connect), "scouting/multicast/enabled": not connect}
    for path, value in settings.items():
        chosen.insert_json5(path, json.dumps(value))
    try:
        return zenoh.open(chosen)
    except zenoh.ZError as error:
        where = ", ".join(map(without_secrets, endpoints_of(chosen, "connect")))
        raise NoAnswer(
            f"no connection to {where or 'any router or service found by scouting'} within {timeout:g} s "
            f"({zenoh_message(error, chosen)})"
        ) from None
