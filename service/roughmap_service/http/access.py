"""Who may see the pages: methods, token, host; and the headers that every answer carries."""

import base64
import binascii
import hmac
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from roughmap_service.host.exposure import is_loopback

OPEN = frozenset({"/healthz", "/readyz"})
"""Paths that need no token: what probes them can't have one. They name no file and no robot without it."""

AUTHORISED = "roughmap.authorised"
"""In the scope of a request: whether it may see all."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""On every answer that doesn't set its own."""


class Access:
    """Stands before an ASGI application, answers what may not pass, and adds the headers.

    ``on_loopback``: the service listens on loopback only. There, without a token, a page in a browser of this machine
    must not reach it under a name that it made point here; so only loopback's own names are answered.
    """

    def __init__(self, app: ASGIApp, token: bytes | None, *, on_loopback: bool) -> None:
        self._app = app
        self._token = token
        self._own_names_only = on_loopback and token is None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        answer = self._refusal(scope) or self._app
        await answer(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if scope["method"] not in ("GET", "HEAD"):
            return _refuse(405, "only GET and HEAD", {"Allow": "GET, HEAD"})
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            return _refuse(413, "a request here has no body")
        if self._own_names_only and "host" in headers and not is_loopback(_host(headers["host"])):
            return _refuse(421, "this address answers to localhost only")
        scope[AUTHORISED] = self._token is None or _shown(headers.get("authorization", ""), self._token)
        if not scope[AUTHORISED] and scope["path"] not in OPEN:
            return _refuse(401, "the service's http token is needed", {"WWW-Authenticate": 'Basic realm="roughmap"'})
        return None


def _refuse(code: int, text: str, headers: dict[str, str] | None = None) -> Response:
    return PlainTextResponse(f"{text}\n", code, {"Connection": "close", **(headers or {})})


def _host(header: str) -> str:
    try:
        return urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return ""


def _shown(authorization: str, token: bytes) -> bool:
    """Whether the header holds the token: ``Bearer TOKEN``, or ``Basic`` with it as the password (what browsers do)."""
    scheme, _, value = authorization.partition(" ")
    shown = value.encode("latin-1")  # the bytes as they came
    if scheme.lower() == "basic":
        try:
            shown = base64.b64decode(value, validate=True).partition(b":")[2]
        except (binascii.Error, ValueError):
            return False
    return scheme.lower() in ("basic", "bearer") and hmac.compare_digest(shown, token)
