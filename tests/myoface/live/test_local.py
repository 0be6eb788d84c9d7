"""A session that is held in this process, with a stand-in for the job."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import pytest

from myoface.client.aio_live import unheard
from myoface.errors import ApiError
from myoface.live.local import hold_session
from solver.errors import InputError
from solver.jobs import Task
from solver.kinds.live_messages import FollowedFrame, GivenFrame, Message
from tests.myoface.live.echo import READY


def echo(task: Task[Any]) -> list[Path]:
    """Give every frame's numbers back until the session is to end."""
    channel = task.channel
    assert channel is not None
    channel.send(Message.of(READY))
    while True:
        message = channel.receive()
        assert message is not None
        if message.is_text:
            return []
        frame = GivenFrame.unpack(message.data)
        numbers = bytes(4 * 21) + frame.numbers + bytes(4 * 2)
        followed = FollowedFrame(frame.number, frame.seconds, 1.0, 0.1, 0.2, 0, 0, numbers)
        channel.send(Message(followed.pack()))


def refuse(_task: Task[Any]) -> list[Path]:
    raise InputError("live.no_face", "the rig has no expressions")


@pytest.fixture
def job(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Put a function in the place of the job."""

    def put(run: Any) -> None:
        monkeypatch.setitem(sys.modules, "solver.jobs.live_session", SimpleNamespace(run=run))  # type: ignore[arg-type]

    return put


def test_frames_are_followed_in_this_process(job: Any, tmp_path: Path) -> None:
    job(echo)

    async def follow() -> list[float]:
        async with hold_session({}, {}, tmp_path / "live", unheard) as face:
            await face.send({"jawOpen": 0.25}, 0.5)
            frame = await face.receive(5.0)
            assert frame is not None
            return list(frame.arrays["values"])

    assert anyio.run(follow) == [0.25, pytest.approx(float("nan"), nan_ok=True)]


def test_what_the_job_raises_comes_as_it_is(job: Any, tmp_path: Path) -> None:
    job(refuse)

    async def follow() -> None:
        async with hold_session({}, {}, tmp_path / "live", unheard):
            pytest.fail("there is no face")

    with pytest.raises(InputError, match="no expressions"):
        anyio.run(follow)


def test_an_error_of_the_session_reaches_who_sends(job: Any, tmp_path: Path) -> None:
    job(lambda task: echo(task) or refuse(task))

    async def follow() -> None:
        async with hold_session({}, {}, tmp_path / "live", unheard) as face:
            await face.tell({"end": True})
            with pytest.raises(ApiError):
                await face.receive()

    with pytest.raises(InputError, match="no expressions"):
        anyio.run(follow)
