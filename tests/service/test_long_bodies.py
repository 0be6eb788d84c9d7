"""Long bodies are dealt with one after the other, their owners in turn, until an answer begins."""

from __future__ import annotations

import anyio
import pytest
from starlette.types import Message, Receive, Scope, Send

from service.access.keys import LETTERS, _checksum
from service.http.bodies import LONG_BYTES, Bodies, _NoTurnError, _Turns

LONG = b" " * (LONG_BYTES + 1)


class Keyring:
    """A key that has worked, of the tenant `known`."""

    def known_tenant(self, text: str) -> str | None:
        return "known" if text == _key(0) else None


def _key(number: int) -> str:
    body = "myo_" + LETTERS[number] * 44
    return body + _checksum(body)


class Edge:
    """Bodies around an application that begins to answer at once, and ends when it may."""

    def __init__(self, seconds: float = 5) -> None:
        self.bodies = Bodies(self._app, Keyring(), seconds, 1)  # type: ignore[arg-type]
        self.began: list[int] = []
        self.may_begin = anyio.Event()
        self.may_end = anyio.Event()

    async def _app(self, scope: Scope, _receive: Receive, send: Send) -> None:
        self.began.append(scope["number"])
        await self.may_begin.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await self.may_end.wait()

    async def ask(self, number: int, method: str = "POST", reads: bool = True) -> int:
        """Send a long body with the key of a number; returns the status."""
        status = 0
        length = str(len(LONG)).encode()
        key = f"Bearer {_key(number)}".encode()
        scope = {
            "type": "http",
            "method": method,
            "path": "/v1/jobs",
            "number": number,
            "client": ("192.0.2.1", 1),
            "state": {"request_id": "x"},
            "headers": [(b"authorization", key), (b"content-length", length)],
        }

        async def receive() -> Message:
            return {"type": "http.request", "body": LONG, "more_body": False}

        async def send(message: Message) -> None:
            nonlocal status
            status = message.get("status", status)
            if not reads:
                await anyio.sleep_forever()

        await self.bodies(scope, receive, send)
        return status


@pytest.mark.parametrize("reads", [True, False], ids=["endless", "slow reader"])
def test_a_turn_ends_where_an_answer_begins(reads: bool) -> None:
    async def run() -> None:
        edge = Edge()
        edge.may_begin.set()
        async with anyio.create_task_group() as group:
            group.start_soon(edge.ask, 1, "POST", reads)
            await anyio.wait_all_tasks_blocked()
            group.start_soon(edge.ask, 2)
            await anyio.wait_all_tasks_blocked()
            assert edge.began == [1, 2]
            group.cancel_scope.cancel()

    anyio.run(run)


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_what_only_reads_has_no_body(method: str) -> None:
    async def run() -> None:
        with anyio.fail_after(1):
            edge = Edge()
            assert await edge.ask(0, method) == 400
            assert edge.began == []

    anyio.run(run)


def test_made_up_keys_share_a_turn() -> None:
    async def run() -> None:
        edge = Edge()
        async with anyio.create_task_group() as group:
            for number in (9, 1, 2, 3, 0):  # the last is a customer
                group.start_soon(edge.ask, number)
                await anyio.wait_all_tasks_blocked()
            edge.may_begin.set()
            edge.may_end.set()
        assert edge.began == [9, 1, 0, 2, 3]

    anyio.run(run)


def test_a_turn_that_does_not_come_is_a_503() -> None:
    async def run() -> None:
        edge = Edge(0.01)
        async with anyio.create_task_group() as group:
            group.start_soon(edge.ask, 0)
            await anyio.wait_all_tasks_blocked()
            assert await edge.ask(1) == 503
            edge.may_begin.set()
            edge.may_end.set()
        assert await edge.ask(2) == 200

    anyio.run(run)


def test_one_at_a_time_and_the_owners_in_turn() -> None:
    done: list[str] = []

    async def ask(turns: _Turns, key: str) -> None:
        async with turns.of(("tenant", key)):
            await anyio.sleep(0)
            done.append(key)
            assert done.count("now") == done.count("over")
            done.append("now")
            await anyio.sleep(0.001)
            done.append("over")

    async def all_of_them() -> None:
        turns = _Turns(5)
        async with anyio.create_task_group() as group:
            for key in "aaaab":
                group.start_soon(ask, turns, key)
                await anyio.sleep(0)
        async with turns.of(("tenant", "c")) as give_back:  # nobody is left in it
            done.append("c")
            give_back()
            give_back()

    anyio.run(all_of_them)
    assert [each for each in done if len(each) == 1] == [*"aabaac"]


def test_who_gives_up_waiting_leaves_no_hole() -> None:
    async def give_up() -> None:
        turns = _Turns(0.01)
        async with turns.of(("tenant", "a")):
            with pytest.raises(_NoTurnError):
                await wait(turns)
        with anyio.fail_after(1):
            async with turns.of(("tenant", "b")):
                pass

    async def wait(turns: _Turns) -> None:
        async with turns.of(("tenant", "a")):
            raise AssertionError

    anyio.run(give_up)
