"""A live session in this process: the job of a service's worker, at the other end of a channel."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import anyio

from myoface.client import ClientOptions
from myoface.client.aio_live import AsyncLiveFace, Listener
from myoface.client.sockets import CLOSED, AsyncSocket
from myoface.errors import ApiError

if TYPE_CHECKING:
    from solver.kinds.live_channel import Channel

LOOK_S = 0.1  # how long a channel is waited for before it is seen whether anybody still waits
OVER = 1000  # the code of a connection that is closed for good


class ChannelSocket(AsyncSocket):
    """A channel with the calls of a WebSocket."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel

    async def send(self, message: bytes | str) -> None:
        """Send a message."""
        from solver.kinds.live_channel import ChannelClosedError
        from solver.kinds.live_messages import Message

        is_text = isinstance(message, str)
        data = message.encode() if isinstance(message, str) else message
        try:
            await anyio.to_thread.run_sync(self._channel.send, Message(data, is_text))
        except ChannelClosedError as error:
            raise _closed() from error

    async def receive(self, timeout: float | None) -> bytes | str | None:
        """Return the next message; None: there is none within ``timeout`` seconds."""
        from solver.kinds.live_channel import ChannelClosedError

        until = None if timeout is None else anyio.current_time() + timeout
        while True:
            left = LOOK_S if until is None else until - anyio.current_time()
            wait = max(0.0, min(left, LOOK_S))
            try:
                message = await anyio.to_thread.run_sync(self._channel.receive, wait)
            except ChannelClosedError as error:
                raise _closed() from error
            if message is not None:
                return message.data.decode() if message.is_text else message.data
            if until is not None and anyio.current_time() >= until:
                return None

    async def close(self) -> None:
        """Close the channel: a session that is not over ends."""
        self._channel.close()


class _NoWayBack:
    """The line of a session whose channel is its only connection."""

    async def connect(self) -> AsyncSocket:
        """Refuse: the session has ended."""
        raise _closed()

    async def error(self) -> None:
        """Return nothing: what the job raises is raised here."""


def _closed() -> ApiError:
    return ApiError({"code": CLOSED, "detail": "the session has ended", "close": OVER})


@asynccontextmanager
async def hold_session(
    files: Mapping[str, Path], options: Mapping[str, Any], out: Path, listen: Listener
) -> AsyncIterator[AsyncLiveFace]:
    """Hold a session on a rig's ``files`` by their roles, and yield its face once it is ready.

    What it makes, and its takes, are left in ``out``; a skin that an earlier session left there is
    read. Raises what the job raises.
    """
    from solver.jobs import run_job
    from solver.kinds import FILES
    from solver.kinds.live_channel import Channel
    from solver.kinds.live_session import KIND

    ours, theirs = Channel.pair()
    kept = [out / name for name in KIND.hands_on if FILES[name].input in KIND.reads]
    given: dict[str, Any] = {path.stem: path for path in kept if path.is_file()}
    given |= files
    failed: list[Exception] = []

    def work() -> None:
        try:
            run_job("live_session", out, options=options, channel=theirs, **given)
        except Exception as error:  # raised where the session is held
            failed.append(error)
        finally:
            theirs.close()

    worker = threading.Thread(target=work, name="live-session", daemon=True)
    worker.start()
    socket = ChannelSocket(ours)
    face = AsyncLiveFace("here", _NoWayBack(), ClientOptions(), listen)
    try:
        await face.open(socket)
        yield face
    except ApiError:
        if not failed:
            raise
    finally:
        with anyio.CancelScope(shield=True):
            await _end(face, worker)
        await socket.close()
    if failed:
        raise failed[0]


async def _end(face: AsyncLiveFace, worker: threading.Thread) -> None:
    """End the session, and hear what it says until it has written its report."""
    try:
        await face.tell({"end": True})
        while worker.is_alive():
            await face.receive(LOOK_S)
    except ApiError:  # it is over
        pass
    await anyio.to_thread.run_sync(worker.join)
