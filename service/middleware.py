"""What surrounds every request: an id, a line in the log, a check of the Host header."""

from __future__ import annotations

import re
import time
import uuid
from collections.abc import Sequence

import structlog
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import Problem, render

ACCEPTED_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}")
HOST = re.compile(r"(?:([^:\[\]@/\s]+)|\[([^\]\s]+)\])(?::\d{1,5})?")
QUIET = frozenset({"/healthz", "/readyz"})

log = structlog.get_logger()


class RequestContext:
    """Gives each request an id (the caller's ``X-Request-Id`` if it is harmless) and logs it.

    A foreign Host header is refused: a web page that rebinds its name to this machine must not
    reach the service with what a browser keeps.
    """

    def __init__(self, app: ASGIApp, allowed_hosts: Sequence[str]) -> None:
        self._app = app
        self._allowed_hosts = frozenset(allowed_hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        given = request.headers.get("x-request-id", "")
        request_id = given if ACCEPTED_ID.fullmatch(given) else uuid.uuid4().hex
        request.state.request_id = request_id
        status = 0
        started = time.perf_counter()

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [
                    *message["headers"],
                    (b"x-request-id", request_id.encode()),
                ]
            await send(message)

        structlog.contextvars.bind_contextvars(request_id=request_id)
        try:
            if _hostname(request) not in self._allowed_hosts:
                problem = Problem(421, "request.host", "this service does not answer to that host")
                await render(request_id, problem)(scope, receive, send_with_id)
            else:
                await self._app(scope, receive, send_with_id)
        except Exception:
            log.exception("request.failed", method=request.method, path=request.url.path)
            if status:
                raise  # the response has begun: only cutting it off tells the client
            problem = Problem(500, "internal", "the service failed; its log has the request id")
            await render(request_id, problem)(scope, receive, send_with_id)
        finally:
            if request.url.path not in QUIET:
                log.info(
                    "request",
                    method=request.method,
                    path=request.url.path,
                    status=status,
                    key=getattr(request.state, "key_id", None),
                    ms=round(1000 * (time.perf_counter() - started), 1),
                )
            structlog.contextvars.unbind_contextvars("request_id")


def _hostname(request: Request) -> str | None:
    """Return the Host header's name; None if it has none, where Starlette would take our own."""
    match = HOST.fullmatch(request.headers.get("host", ""))
    return (match[1] or match[2]).lower() if match else None


class BodyLimit:
    """Refuses bodies above ``limit`` bytes, except an upload's, which are never held in memory."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read the whole body first: afterwards FastAPI would call any error a parsing error."""
        if scope["type"] != "http" or scope["method"] == "PATCH":
            await self._app(scope, receive, send)
            return
        body = bytearray()
        more = True
        while more:
            message = await receive()
            body += message.get("body", b"")
            more = message.get("more_body", False)
            if len(body) > self._limit:
                problem = Problem(
                    413, "request.too_large", "the body is too large", expected=self._limit
                )
                request_id = Request(scope).state.request_id
                await render(request_id, problem)(scope, receive, send)
                return
        whole: list[Message] = [{"type": "http.request", "body": bytes(body), "more_body": False}]

        async def receive_again() -> Message:
            return whole.pop() if whole else await receive()

        await self._app(scope, receive_again, send)
