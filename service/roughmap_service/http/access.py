"""Which requests are answered, by method, token and host; and the security headers of every response."""

import base64
import binascii
import hmac
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from roughmap_service.host.exposure import is_loopback

OPEN = frozenset({"/healthz", "/readyz"})
"""Paths that need no token, since probes have none. Without a token they name no file and no robot."""

AUTHORISED = "roughmap.authorised"
"""Key in a request's scope: whether the request may see everything."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Set on every response that does not set its own."""


class Access:
    """ASGI middleware that refuses requests and adds the headers.

    ``on_loopback``: the service listens on loopback only. If there is no token either, only loopback's own names are
    answered: otherwise a web page in a browser on this machine could read the pages through a host name that resolves
    to loopback (DNS rebinding).
    """

    def __init__(self, app: ASGIApp, token: bytes | None, *, on_loopback: bool) -> None:
        self._app = app
        self._token = token
        self._own_names_only = on_loopback and token is None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        respond = self._refusal(scope) or self._app
        await respond(scope, receive, send_with_headers)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        if scope["method"] not in ("GET", "HEAD"):
            return _refuse(405, "only GET and HEAD are allowed", {"Allow": "GET, HEAD"})
        if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
            return _refuse(413, "requests must not have a body")
        if self._own_names_only and "host" in headers and not is_loopback(_host(headers["host"])):
            return _refuse(421, "this address is served under the name localhost only")
        scope[AUTHORISED] = self._token is None or _shown(headers.get("authorization", ""), self._token)
        if not scope[AUTHORISED] and scope["path"] not in OPEN:
            return _refuse(
                401,
                "the token of the service is required (http.token_file)",
                {"WWW-Authenticate": 'Basic realm="roughmap"'},
            )
        return None


def _refuse(code: int, text: str, headers: dict[str, str] | None = None) -> Response:
    return PlainTextResponse(f"{text}\n", code, {"Connection": "close", **(headers or {})})


def _host(header: str) -> str:
    try:
        return urlsplit(f"//{header}").hostname or ""
    except ValueError:
        return ""


def _shown(authorization: str, token: bytes) -> bool:
    """Return whether the header holds the token: ``Bearer TOKEN``, or ``Basic`` with it as the password (browsers)."""
    scheme, _, value = authorization.partition(" ")
    shown = value.encode("latin-1")  # the bytes as received
    if scheme.lower() == "basic":
        try:
            shown = base64.b64decode(value, validate=True).partition(b":")[2]
        except (binascii.Error, ValueError):
            return False
    return scheme.lower() in ("basic", "bearer") and hmac.compare_digest(shown, token)
