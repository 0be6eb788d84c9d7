"""Receive requests' bodies: of those with a key, bounded in size and time, JSON only if strict.

Nobody's body is read before the request has shown something of a key's form: no route takes one
without. An upload's bytes are not held in memory. They may take as long as they keep a least rate;
every other body is small and has one time limit for the whole of it. Long ones are dealt with one
after the other until their answers begin: several at a time would leave little of the processor to
everybody else.
"""

from __future__ import annotations

import email.message
import json
import math
import re
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager
from typing import Any

from anyio import Event, move_on_after, to_thread
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.keys import Keyring, check_text
from service.access.principal import missing_problem
from service.errors import Problem, render

UPLOAD = re.compile(r"/v1/uploads/[^/]+")
# Routes with scenes and with a session's scans
LARGER = re.compile(r"/v1/(jobs(/[^/]+(/retry)?)?|batches)")
MOST_BYTES = 64 * 1024
MOST_BYTES_LARGER = 1024**2
# Methods that no route reads a body of
BODILESS = frozenset({"GET", "HEAD"})
# A body above it is parsed in a thread, and waits for its turn: others are answered meanwhile
LONG_BYTES = 16 * 1024
DISCONNECT: Message = {"type": "http.disconnect"}

DEEPEST = 32
# Lists and objects of a body: a scene of 10,000 keys has some 40,000
MOST_CONTAINERS = 50_000
# Members of an object
MOST_MEMBERS = 512
_UNICODE_FAULT = re.compile("[\x00\ud800-\udfff]")


class Bodies:
    """Receives bodies as large as their route needs, within ``seconds``.

    A long one then waits for its turn, which tenants of ``keyring`` take, for as long at most. An
    upload's bytes are passed on as they come, as long as the client, given ``seconds`` in advance,
    sends at least ``min_rate`` bytes a second.
    """

    def __init__(self, app: ASGIApp, keyring: Keyring, seconds: float, min_rate: float) -> None:
        self._app = app
        self._keyring = keyring
        self._seconds = seconds
        self._min_rate = min_rate
        self._turns = _Turns(seconds)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif problem := _refuse_unread(scope):
            await render(Request(scope).state.request_id, problem)(scope, receive, send)
        elif scope["method"] == "PATCH" and UPLOAD.fullmatch(scope["path"]):
            await self._pass_on(scope, receive, send)
        else:
            await self._read_first(scope, receive, send)

    async def _read_first(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Read the whole body first: afterwards FastAPI would call any error a parsing error."""
        try:
            body = await self._whole(receive, _limit(scope))
        except Problem as problem:
            await render(Request(scope).state.request_id, problem)(scope, receive, send)
            return
        if body is None:
            return  # the client has gone: half an order is none
        if len(body) > LONG_BYTES:
            await self._serve_in_turn(body, scope, receive, send)
        else:
            await self._serve(body, scope, receive, send)

    async def _serve_in_turn(self, body: bytes, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a long body; an answer may take for ever to be read, and does so without a turn."""
        try:
            async with self._turns.of(self._owner(scope)) as give_back:

                async def send_without_turn(message: Message) -> None:
                    give_back()
                    await send(message)

                await self._serve(body, scope, receive, send_without_turn)
        except _NoTurnError:
            problem = Problem(503, "request.busy", "too many long bodies wait; send it again")
            problem.headers = {"Retry-After": "5"}
            await render(Request(scope).state.request_id, problem)(scope, receive, send)

    def _owner(self, scope: Scope) -> tuple[str, str]:
        """Return whose turn it is: the tenant's of a key that has worked, or else the address's."""
        text = Headers(scope=scope).get("authorization", "").partition(" ")[2].strip()
        if tenant_id := self._keyring.known_tenant(text):
            return "tenant", tenant_id
        client = scope.get("client")
        return "address", client[0] if client else ""

    async def _serve(self, body: bytes, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            if body and _is_json(Request(scope).headers.get("content-type", "")):
                if len(body) > LONG_BYTES:
                    await to_thread.run_sync(check_json, body)
                else:
                    check_json(body)
        except Problem as problem:
            await render(Request(scope).state.request_id, problem)(scope, receive, send)
            return
        whole: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def receive_again() -> Message:
            return whole.pop() if whole else await receive()

        await self._app(scope, receive_again, send)

    async def _whole(self, receive: Receive, limit: int) -> bytes | None:
        body = bytearray()
        more = True
        with move_on_after(self._seconds) as patience:
            while more:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                more = message.get("more_body", False)
                if len(body) > limit:
                    raise _too_large(limit)
        if patience.cancelled_caught:
            raise _too_slow(f"the body did not arrive within {self._seconds:g} s")
        return bytes(body)

    async def _pass_on(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Cut off who sends too slowly, as if the connection had broken: what arrived counts."""
        source = _BodySender(receive, self._seconds, self._min_rate)

        async def send_unless_too_slow(message: Message) -> None:
            if not source.too_slow:
                await send(message)

        await self._app(scope, source.receive, send_unless_too_slow)
        if source.too_slow:
            problem = _too_slow(f"bytes must come at {self._min_rate:g} a second or faster")
            await render(Request(scope).state.request_id, problem)(scope, receive, send)


class _NoTurnError(Exception):
    """A request whose turn did not come in time."""


class _Turns:
    """Lets one request of a long body in at a time; those who wait do so for ``seconds`` at most.

    The owners of waiting requests take turns.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._is_taken = False
        self._waiting: dict[tuple[str, str], deque[Event]] = {}

    @asynccontextmanager
    async def of(self, owner: tuple[str, str]) -> AsyncIterator[Callable[[], None]]:
        """Wait for a turn and have it; gives what gives it back, the first time it is called."""
        if self._is_taken:
            with move_on_after(self._seconds) as patience:
                await self._wait(owner)
            if patience.cancelled_caught:
                raise _NoTurnError
        self._is_taken = True
        with ExitStack() as turn:
            turn.callback(self._pass_on)
            yield turn.close

    async def _wait(self, owner: tuple[str, str]) -> None:
        called = Event()
        self._waiting.setdefault(owner, deque()).append(called)
        try:
            await called.wait()
        except BaseException:  # it takes too long, or the server stops
            if called.is_set():
                self._pass_on()
            else:
                self._waiting[owner].remove(called)
            raise

    def _pass_on(self) -> None:
        """Call the next, if there is one; its owner is the last from then on."""
        while self._waiting:
            owner = next(iter(self._waiting))
            waiting = self._waiting.pop(owner)
            if waiting:
                waiting.popleft().set()
                self._waiting[owner] = waiting
                return
        self._is_taken = False


class _BodySender:
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


def _refuse_unread(scope: Scope) -> Problem | None:
    """Return why a body is not read at all: it has no key, says it is too large, or has no reader.

    The key need only look like one: whose it is, the route asks.
    """
    headers = Headers(scope=scope)
    length = headers.get("content-length", "0")
    if "transfer-encoding" not in headers and not length.strip("0"):
        return None
    scheme, _, text = headers.get("authorization", "").partition(" ")
    try:
        if scheme.lower() != "bearer":
            raise missing_problem()
        check_text(text.strip())
    except Problem as problem:
        return _closing(problem)
    is_upload = scope["method"] == "PATCH" and UPLOAD.fullmatch(scope["path"])
    if not is_upload and length.isdecimal() and int(length) > _limit(scope):
        return _too_large(_limit(scope))
    if scope["method"] in BODILESS:
        return _closing(Problem(400, "request.body", f"a {scope['method']} has no body here"))
    return None


def _limit(scope: Scope) -> int:
    return MOST_BYTES_LARGER if LARGER.fullmatch(scope["path"]) else MOST_BYTES


def _too_large(limit: int) -> Problem:
    return _closing(Problem(413, "request.too_large", "the body is too large", expected=limit))


def _too_slow(detail: str) -> Problem:
    return _closing(Problem(408, "request.timeout", detail))


def _closing(problem: Problem) -> Problem:
    """End the connection with the answer: the rest of the body is not wanted."""
    problem.headers["Connection"] = "close"
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

    Refused are NaN and infinity (also as ``1e999``), an object with a name twice or with more than
    :data:`MOST_MEMBERS`, more than :data:`MOST_CONTAINERS` lists and objects, nesting deeper than
    :data:`DEEPEST`, other encodings than UTF-8, and text that no database column holds (NUL,
    half of a surrogate pair).

    Raises
    ------
    Problem
        422 ``request.json``.
    """
    if body.count(b"[") + body.count(b"{") > MOST_CONTAINERS:  # those in texts as well
        raise _json_problem(f"it has more than {MOST_CONTAINERS} lists and objects")
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
        # first of all: a megabyte may be half a million numbers
        parts = [item for item in level if isinstance(item, (str, list, dict))]
        level = []
        for item in parts:
            if isinstance(item, str):
                if _UNICODE_FAULT.search(item):
                    raise _json_problem("a text holds NUL, or half of a surrogate pair")
                continue
            level += item
            if isinstance(item, dict):
                level += item.values()
    raise _json_problem(f"it is nested deeper than {DEEPEST}")


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number in JSON")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:32]} is too large a number")
    return number


def _no_name_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(pairs) > MOST_MEMBERS:
        raise ValueError(f"an object has more than {MOST_MEMBERS} members")
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("an object has a name twice")
    return found


def _json_problem(what: str) -> Problem:
    return Problem(422, "request.json", f"the body is not valid JSON: {what}")
