"""Receive requests' bodies: bounded in size and time, and JSON only if it is strict.

An upload's bytes are not held in memory. They may take as long as they keep a least rate; every
other body is small and has one time limit for the whole of it.
"""

from __future__ import annotations

import email.message
import json
import math
import re
import time
from typing import Any

from anyio import move_on_after
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import Problem, render

UPLOAD = re.compile(r"/v1/uploads/[^/]+")
DISCONNECT: Message = {"type": "http.disconnect"}

DEEPEST = 32
_UNICODE_FAULT = re.compile("[\x00\ud800-\udfff]")


class Bodies:
    """Receives bodies of at most ``limit`` bytes within ``seconds``.

    An upload's bytes are passed on as they come, as long as the client, given ``seconds`` in
    advance, sends at least ``min_rate`` bytes a second.
    """

    def __init__(self, app: ASGIApp, limit: int, seconds: float, min_rate: float) -> None:
        self._app = app
        self._limit = limit
        self._seconds = seconds
        self._min_rate = min_rate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif scope["method"] == "PATCH" and UPLOAD.fullmatch(scope["path"]):
            await self._pass_on(scope, receive, send)
        else:
            await self._read_first(scope, receive, send)

    async def _read_first(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read the whole body first: afterwards FastAPI would call any error a parsing error."""
        try:
            body = await self._whole(receive)
            if body is None:
                return  # the client has gone: half an order is none
            if body and _is_json(Request(scope).headers.get("content-type", "")):
                check_json(body)
        except Problem as problem:
            await render(Request(scope).state.request_id, problem)(scope, receive, send)
            return
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive_again() -> Message:
            return whole.pop() if whole else await receive()

        await self._app(scope, receive_again, send)

    async def _whole(self, receive: Receive) -> bytes | None:
        body = bytearray()
        more = True
        with move_on_after(self._seconds) as patience:
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                more = message.get("more_body", False)
                if len(body) > self._limit:
                    raise _closing(
                        Problem(
                            413, "request.too_large", "the body is too large", expected=self._limit
                        )
                    )
        if patience.cancelled_caught:
            raise _too_slow(f"the body did not arrive within {self._seconds:g} s")
        return bytes(body)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Cut off who sends too slowly, as if the connection had broken: what arrived counts."""
        source = _Source(receive, self._seconds, self._min_rate)

        async def send_unless_too_slow(message: Message) -> None:
            if not source.too_slow:
                await send(message)

        await self._app(scope, source.receive, send_unless_too_slow)
        if source.too_slow:
            problem = _too_slow(f"bytes must come at {self._min_rate:g} a second or faster")
            await render(Request(scope).state.request_id, problem)(scope, receive, send)


class _Source:
    """A client that sends a body: it may let us wait for a time that grows with what it sent."""

    def __init__(self, receive: Receive, seconds: float, rate: float) -> None:
        self._receive = receive
        self._patience = seconds
        self._rate = rate
        self._more = True
        self.too_slow = False

    async def receive(self) -> Message:
        if self.too_slow:
            return DISCONNECT
        if not self._more:
            return await self._receive()
        started = time.monotonic()
        message = DISCONNECT
        with move_on_after(max(self._patience, 0)) as patience:
            message = await self._receive()
        self.too_slow = patience.cancelled_caught
        sent = len(message.get("body", b""))
        self._patience += sent / self._rate - (time.monotonic() - started)
        self._more = message.get("more_body", False)
        return message


def _too_slow(detail: str) -> Problem:
    return _closing(Problem(408, "request.timeout", detail))


def _closing(problem: Problem) -> Problem:
    """End the connection with the answer: the rest of the body is not wanted."""
    problem.headers = {"Connection": "close"}
    return problem


def _is_json(content_type: str) -> bool:
    """Return whether FastAPI will read a body of this type as JSON; decided as it does."""
    message = email.message.Message()
    message["content-type"] = content_type
    subtype = message.get_content_subtype()
    is_json = subtype == "json" or subtype.endswith("+json")
    return message.get_content_maintype() == "application" and is_json


def check_json(body: bytes) -> None:
    """Refuse a body that is not JSON as RFC 8259 has it: parsers would read it differently.

    Refused are NaN and infinity (also as ``1e999``), an object with a name twice, nesting deeper
    than :data:`DEEPEST`, other encodings than UTF-8, and text that no database column holds (NUL,
    half of a surrogate pair).

    Raises
    ------
    Problem
        422 ``request.json``.
    """
    try:
        value = json.loads(
            body.decode(),
            parse_constant=_no_constant,
            parse_float=_finite,
            object_pairs_hook=_no_name_twice,
        )
    except RecursionError:
        raise _json_problem(f"it is nested deeper than {DEEPEST}") from None
    except json.JSONDecodeError as error:
        raise _json_problem(f"{error.msg}, line {error.lineno} column {error.colno}") from None
    except UnicodeDecodeError:
        raise _json_problem("it is not UTF-8") from None
    except ValueError as error:
        raise _json_problem(str(error)) from None
    _check_nesting(value)


def _check_nesting(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST + 1):
        if not level:
            return
        for item in level:
            if isinstance(item, str) and _UNICODE_FAULT.search(item):
                raise _json_problem("a text holds NUL, or half of a surrogate pair")
        level = [inner for item in level for inner in _parts(item)]
    raise _json_problem(f"it is nested deeper than {DEEPEST}")


def _parts(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return [*value.keys(), *value.values()]
    return value if isinstance(value, list) else []


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:32]} is too large a number")
    return number


def _no_name_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("an object has a name twice")
    return found


def _json_problem(what: str) -> Problem:
    return Problem(422, "request.json", f"the body is not valid JSON: {what}")
