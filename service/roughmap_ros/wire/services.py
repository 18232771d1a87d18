"""Services: requests are checked and copied in Zenoh's threads, and answered by a thread of their own."""

import logging
import queue
import threading
import time
from collections.abc import Callable
from typing import Final, NamedTuple

import zenoh

from roughmap_ros.wire.attachment import Attachment, pack_attachment
from roughmap_ros.wire.errors import zenoh_errors
from roughmap_ros.wire.refusals import Refusals
from roughmap_ros.wire.subscriber import Refused, read_attachment
from roughmap_schemas.faults import ReportedError

logger = logging.getLogger(__name__)

MAX_WAITING: Final = 16
"""Requests that wait for an answer; more are refused."""

MAX_REQUEST: Final = 64 << 10
"""Bytes of a request. A GetMap's has one."""


class Request(NamedTuple):
    """A request that waits: ``beside`` is what rmw_zenoh sent beside it."""

    service: "Service"
    query: zenoh.Query
    payload: bytes
    beside: Attachment | None


class Service(NamedTuple):
    """A service: its name and key, whether requests have attachments, and what answers a request's CDR with CDR."""

    name: str
    key: str
    attached: bool
    handler: Callable[[bytes], bytes]


class Services:
    """The services of a node. A handler may take its time and use Zenoh itself: requests wait for one another."""

    def __init__(self, refusals: Refusals) -> None:
        self._refusals = refusals
        self._waiting: queue.Queue[Request | None] = queue.Queue(MAX_WAITING)
        self._thread: threading.Thread | None = None

    def declare(self, session: zenoh.Session, service: Service) -> Callable[[], object]:
        """Declare a service; return what undeclares it. Raises WireError."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="ros-services", daemon=True)
            self._thread.start()

        def take(query: zenoh.Query) -> None:
            self._take(service, query)

        handler = zenoh.handlers.Callback(take, indirect=False)
        with zenoh_errors(service.name):
            return session.declare_queryable(service.key, handler, complete=True).undeclare

    def close(self) -> None:
        """Answer what waits, then end the thread."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._thread = None

    def _take(self, service: Service, query: zenoh.Query) -> None:
        try:
            payload = query.payload
            if payload is None:
                raise Refused("expected a request in CDR; found none")
            if len(payload) > MAX_REQUEST:
                raise Refused(f"expected a request of at most {MAX_REQUEST} bytes; found {len(payload)}")
            beside = read_attachment(query.attachment) if service.attached else None
            self._waiting.put_nowait(Request(service, query, payload.to_bytes(), beside))
        except queue.Full:
            self._refuse(service, query, f"{MAX_WAITING} requests wait already")
        except ReportedError as error:
            self._refuse(service, query, str(error)[:500])

    def _run(self) -> None:
        while (request := self._waiting.get()) is not None:
            service, query = request.service, request.query
            try:
                self._reply(request, service.handler(request.payload))
            except ReportedError as error:
                self._refuse(service, query, str(error)[:500])
            except Exception:  # a thread that ended would leave later requests without answers
                logger.exception("a request of %s failed", service.name)
                self._refuse(service, query, "an internal error; see the log lines")

    def _reply(self, request: Request, payload: bytes) -> None:
        came = request.beside
        beside = None if came is None else pack_attachment(came._replace(source_ns=time.time_ns()))
        with zenoh_errors(request.service.name), request.query:
            request.query.reply(request.service.key, payload, attachment=beside)

    def _refuse(self, service: Service, query: zenoh.Query, reason: str) -> None:
        """Send an error and end the query: it would else be open as long as anyone holds it."""
        self._refusals.count(service.name, reason)
        try:
            with query:
                query.reply_err(reason)
        except zenoh.ZError as error:  # the session is closed, or the asker gone
            logger.info("%s: a refusal could not be sent: %s", service.name, error)
