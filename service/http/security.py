"""Protection of a browser's user: allowed hosts and origins, and what a page may load."""

from __future__ import annotations

import re
from collections.abc import Sequence

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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

YEAR = 365 * 24 * 3600


class Security:
    """Refuses foreign hosts and other sites' requests, and adds the headers browsers obey.

    A foreign Host header is refused: a web page that rebinds its name to this machine must not
    reach the service with what a browser keeps.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: Sequence[str]) -> None:
        self._app = app
        self._allowed_hosts = frozenset(map(str.lower, allowed_hosts))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
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
            await send(message)

        if problem := self._refuse(request):
            answer = render(request.state.request_id, problem)
            await answer(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)

    def _refuse(self, request: Request) -> Problem | None:
        if {"content-length", "transfer-encoding"} <= set(request.headers):
            problem = Problem(400, "request.malformed", "the body has two lengths")
            problem.headers = {"Connection": "close"}  # where it ends is anybody's guess
            return problem
        if _hostname(request) not in self._allowed_hosts:
            return Problem(421, "request.host", "this service does not answer to that host")
        site = request.headers.get("sec-fetch-site", "none")
        if request.method not in READING and site not in ("none", "same-origin"):
            return Problem(403, "request.cross_site", "another site's page may not do this")
        return None


def _hostname(request: Request) -> str | None:
    """Return the Host header's name; None if it has none, where Starlette would take our own."""
    match = HOST.fullmatch(request.headers.get("host", ""))
    return (match[1] or match[2]).lower() if match else None
