"""Long bodies are dealt with one after the other, the keys in turn."""

from __future__ import annotations

import anyio

from service.http.bodies import _Turns


def test_one_at_a_time_and_the_keys_in_turn() -> None:
    done: list[str] = []

    async def ask(turns: _Turns, key: str) -> None:
        async with turns.of(key):
            await anyio.sleep(0)
            done.append(key)
            assert done.count("now") == done.count("over")
            done.append("now")
            await anyio.sleep(0.001)
            done.append("over")

    async def all_of_them() -> None:
        turns = _Turns()
        async with anyio.create_task_group() as group:
            for key in "aaaab":
                group.start_soon(ask, turns, key)
                await anyio.sleep(0)
        async with turns.of("c"):  # nobody is left in it
            done.append("c")

    anyio.run(all_of_them)
    assert [each for each in done if len(each) == 1] == [*"aabaac"]


def test_who_gives_up_waiting_leaves_no_hole() -> None:
    async def give_up() -> None:
        turns = _Turns()
        async with anyio.create_task_group() as group, turns.of("a"):
            group.start_soon(wait, turns)
            await anyio.sleep(0.01)
            group.cancel_scope.cancel()
        with anyio.fail_after(1):
            async with turns.of("b"):
                pass

    async def wait(turns: _Turns) -> None:
        async with turns.of("a"):
            raise AssertionError

    anyio.run(give_up)
