"""A session that gives weights back, over sockets as the client's are."""

from __future__ import annotations

import json
from typing import Any

import anyio
from anyio.streams.memory import MemoryObjectReceiveStream, MemoryObjectSendStream

from myoface.client import ClientOptions
from myoface.client.aio_live import AsyncLiveFace, Listener
from myoface.client.sockets import AsyncSocket
from solver.kinds.live_messages import FollowedFrame, GivenFrame

NAMES = ("jawOpen", "mouthLeft")
LAYOUT = {"head": [4, 4], "jaw": [5], "values": [2], "amounts": [1], "contractions": [1]}
READY: dict[str, Any] = {
    "type": "ready",
    "source": "weights",
    "expects": {"rows": 2, "width": 1, "labels": list(NAMES)},
    "layout": [{"name": name, "shape": shape} for name, shape in LAYOUT.items()],
    "sliders": list(NAMES),
    "muscles": ["masseter"],
}


class EchoSocket(AsyncSocket):
    """Answers frames after ``delay_s``; ends by itself after ``most`` of them."""

    def __init__(self, delay_s: float = 0.0, most: int | None = None) -> None:
        self.wishes: list[dict[str, Any]] = []
        self.frames: list[GivenFrame] = []
        self._delay_s = delay_s
        self._most = most
        streams = anyio.create_memory_object_stream[bytes | str](10_000)
        self._out: MemoryObjectSendStream[bytes | str] = streams[0]
        self._in: MemoryObjectReceiveStream[bytes | str] = streams[1]
        self._tell(READY)

    async def send(self, message: bytes | str) -> None:
        if isinstance(message, str):
            self._take(json.loads(message))
            return
        await anyio.sleep(self._delay_s)
        frame = GivenFrame.unpack(message)
        self.frames.append(frame)
        numbers = bytes(4 * 21) + frame.numbers + bytes(4 * 2)
        followed = FollowedFrame(frame.number, frame.seconds, 1.0, 0.1, 0.2, 3, 0, numbers)
        self._out.send_nowait(followed.pack())
        if len(self.frames) == self._most:
            self._tell({"type": "ended", "reason": "idle"})

    async def receive(self, timeout: float | None) -> bytes | str | None:
        with anyio.move_on_after(timeout):
            return await self._in.receive()
        return None

    async def close(self) -> None:
        """Keep what was said."""

    def _take(self, wish: dict[str, Any]) -> None:
        self.wishes.append(wish)
        if "record" in wish:
            self._tell({"type": "recording", "name": wish["record"]})
        if "stop" in wish:
            about = {"name": "take 1", "file": "take_1.csv", "frames": len(self.frames)}
            self._tell({"type": "take", **about, "seconds": 1.0})

    def _tell(self, said: dict[str, Any]) -> None:
        self._out.send_nowait(json.dumps(said))


class EchoLine:
    """The way to an echo, which is always the same."""

    def __init__(self, socket: EchoSocket) -> None:
        self._socket = socket

    async def connect(self) -> AsyncSocket:
        return self._socket

    async def error(self) -> None:
        return None


async def echo_face(socket: EchoSocket, listen: Listener) -> AsyncLiveFace:
    """Return the face of an echo, ready."""
    face = AsyncLiveFace("echo", EchoLine(socket), ClientOptions(), listen)
    await face.open(socket)
    return face
