"""Protection of a browser's user: allowed hosts and origins, and what a page may load."""

from __future__ import annotations

import re
from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection, Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket

from service.access.signed import PARAMETER, SIGNED
from service.errors import Problem, render

HOST = re.compile(r"(?:([^:\[\]@/\s]+)|\[([^\]\s]+)\])(?::\d{1,5})?")
READING = frozenset({"GET", "HEAD", "OPTIONS"})
# On every answer; a route that serves a page sets its own policy
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
}

FOREIGN_HOST = "this service does not answer to that host"
FOREIGN_PAGE = "another site's page may not do this"

YEAR = 365 * 24 * 3600

# What another site's viewer may do with a signed URL (CORS), and what it sees of the answer
ANY_ORIGIN = "*"
VIEWERS_METHODS = ("GET", "HEAD")
PREFLIGHT = {
    "Access-Control-Allow-Methods": ", ".join(VIEWERS_METHODS),
    "Access-Control-Allow-Headers": "Range, If-Range, If-None-Match",
    "Access-Control-Max-Age": "600",
}
SHOWN = "Accept-Ranges, Content-Disposition, Content-Length, Content-Range, ETag, Retry-After"


class Security:
    """Refuses foreign hosts and other sites' requests, and adds the headers browsers obey.

    A foreign Host header is refused: a web page that rebinds its name to this machine must not
    reach the service with what a browser keeps. Pages of ``viewer_origins`` may read what signed
    URLs open, and no other answer.
    """

    def __init__(
        self, app: ASGIApp, allowed_hosts: Sequence[str], viewer_origins: Sequence[str] = ()
    ) -> None:
        self._app = app
        self._allowed_hosts = frozenset(map(str.lower, allowed_hosts))
        self._viewer_origins = frozenset(viewer_origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "websocket":
            await self._serve_socket(WebSocket(scope, receive, send))
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
                if request.url.scheme == "https":
                    headers.setdefault("Strict-Transport-Security", f"max-age={YEAR}")
                if self._viewer_origins and getattr(request.state, SIGNED, False):
                    headers.add_vary_header("Origin")
                    if origin := self._viewer(request):
                        headers["Access-Control-Allow-Origin"] = origin
                        headers["Access-Control-Expose-Headers"] = SHOWN
            await send(message)

        if problem := self._refuse(request):
            answer = render(request.state.request_id, problem)
            await answer(scope, receive, send_with_headers)
        elif self._is_preflight(request):
            setattr(request.state, SIGNED, True)
            await Response(status_code=204, headers=PREFLIGHT)(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)

    async def _serve_socket(self, socket: WebSocket) -> None:
        """Serve one WebSocket; a browser says by itself whose page opens it."""
        origin = socket.headers.get("origin")
        is_own = origin is None or urlsplit(origin).netloc == socket.headers.get("host")
        if _hostname(socket) not in self._allowed_hosts:
            problem = Problem(421, "request.host", FOREIGN_HOST)
        elif not is_own and self._viewer(socket) is None:
            problem = Problem(403, "request.cross_site", FOREIGN_PAGE)
        else:
            await self._app(socket.scope, socket.receive, socket.send)
            return
        await socket.send_denial_response(render(socket.state.request_id, problem))

    def _viewer(self, request: HTTPConnection) -> str | None:
        """Return the site of the page that asks, if it is one that may read signed URLs."""
        origin = request.headers.get("origin")
        is_viewer = origin in self._viewer_origins or ANY_ORIGIN in self._viewer_origins
        return origin if is_viewer else None

    def _is_preflight(self, request: Request) -> bool:
        """Tell whether a viewer's browser asks if it may read a signed URL."""
        return (
            request.method == "OPTIONS"
            and PARAMETER in request.query_params
            and request.headers.get("access-control-request-method") in VIEWERS_METHODS
            and self._viewer(request) is not None
        )

    def _refuse(self, request: Request) -> Problem | None:
        if {"content-length", "transfer-encoding"} <= set(request.headers):
            problem = Problem(400, "request.malformed", "the body has two lengths")
            problem.headers = {"Connection": "close"}  # where it ends is anybody's guess
            return problem
        if _hostname(request) not in self._allowed_hosts:
            return Problem(421, "request.host", FOREIGN_HOST)
        site = request.headers.get("sec-fetch-site", "none")
        if request.method not in READING and site not in ("none", "same-origin"):
            return Problem(403, "request.cross_site", FOREIGN_PAGE)
        return None


def _hostname(request: HTTPConnection) -> str | None:
    """Return the Host header's name; None if it has none, where Starlette would take our own."""
    match = HOST.fullmatch(request.headers.get("host", ""))
    return (match[1] or match[2]).lower() if match else None
