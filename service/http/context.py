"""Context of every request: an id, a line in the log, an answer if the service itself fails."""

from __future__ import annotations

import re
import time
import uuid
from urllib.parse import quote

import structlog
from starlette.requests import HTTPConnection, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import tracing
from service.errors import Problem, render
from service.system.metrics import method_of, route_of

ACCEPTED_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
QUIET = frozenset({"/healthz", "/readyz"})

log = structlog.get_logger()

# A path of no route that is logged is cut to this
LONGEST_PATH = 200


def path_of(scope: Scope) -> str:
    """Return the path for the log: no names of people's expressions, nothing but plain letters.

    That is the route with its ids put in, or the path of no route, percent-encoded.
    """
    route = getattr(scope.get("route"), "path", None)
    if route is None:
        return quote(scope["path"], safe="/", errors="replace")[:LONGEST_PATH]
    for name, value in scope.get("path_params", {}).items():
        if name.endswith("_id") and ACCEPTED_ID.fullmatch(str(value)):
            route = route.replace(f"{{{name}}}", str(value))
    return str(route)


class RequestContext:
    """Gives each request an id (the caller's ``X-Request-Id`` if it is harmless) and logs it."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] == "websocket":
            await self._serve_socket(scope, receive, send)
            return
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        request_id = _identify(request)
        status = 0
        started = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [*message["headers"], (b"x-request-id", request_id.encode())]
            await send(message)

        structlog.contextvars.bind_contextvars(request_id=request_id)
        try:
            if request.url.path in QUIET:
                await self._app(scope, receive, send_with_id)
                return
            with tracing.serving(request.headers, request_id) as span:
                try:
                    await self._app(scope, receive, send_with_id)
                finally:
                    if span is not None:
                        tracing.note_answer(span, method_of(scope), route_of(scope), status)
        except Exception:
            log.exception("request.failed", method=method_of(scope), path=path_of(scope))
            if status:
                raise  # the response has begun: only cutting it off tells the client
            problem = Problem(500, "internal", "the service failed; its log has the request id")
            await render(request_id, problem)(scope, receive, send_with_id)
        finally:
            if request.url.path not in QUIET:
                log.info(
                    "request",
                    method=method_of(scope),
                    path=path_of(scope),
                    status=status,
                    key=getattr(request.state, "key_id", None),
                    ms=round(1000 * (time.perf_counter() - started), 1),
                )
            structlog.contextvars.unbind_contextvars("request_id")

    async def _serve_socket(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one WebSocket, which is logged when it ends; its address has a ticket."""
        request_id = _identify(HTTPConnection(scope))
        started = time.perf_counter()
        with structlog.contextvars.bound_contextvars(request_id=request_id):
            try:
                await self._app(scope, receive, send)
            finally:
                seconds = round(time.perf_counter() - started, 1)
                log.info("socket", path=path_of(scope), seconds=seconds)


def _identify(connection: HTTPConnection) -> str:
    """Return the id of a request, noted in its state."""
    given = connection.headers.get("x-request-id", "")
    request_id = given if ACCEPTED_ID.fullmatch(given) else uuid.uuid4().hex
    connection.state.request_id = request_id
    return request_id
