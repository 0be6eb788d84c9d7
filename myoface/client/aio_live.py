"""Live sessions: a face of a rig that follows frames as they are captured."""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, Protocol

import anyio

from myoface.client.aio_captures import AsyncCaptures
from myoface.client.answers import read_json
from myoface.client.jobs import by_origin
from myoface.client.live_frames import (
    LiveFrame,
    LiveSession,
    LiveTicket,
    Numbers,
    OpenedSession,
    Timed,
    pack_frame,
    read_frame,
)
from myoface.client.retry import Backoff, ClientOptions
from myoface.client.sockets import (
    CLOSED,
    AsyncLock,
    AsyncSocket,
    address_of,
    async_last_words,
    describe_proxy,
)
from myoface.errors import UNREACHABLE, ApiError
from myoface.resources import Artifact, FromJob, Rig

ENDED = "client.ended"
# Codes of connections after which nobody comes back: the session's end, another station, a revoked
# key, a message that is too large
FOR_GOOD = (1000, 4001, 4003, 1009)
MOST_FAULTS = 100  # that are kept

# Called with whatever a session says in words
Listener = Callable[[dict[str, Any]], None]


def unheard(_words: dict[str, Any], /) -> None:
    """Let a session speak without listening."""


class AsyncLiveSessions(AsyncCaptures):
    """Calls about live sessions."""

    @asynccontextmanager
    async def live(
        self,
        rig: str | Rig,
        *,
        source: str = "weights",
        captures: Iterable[str | Artifact | FromJob] = (),
        options: dict[str, Any] | None = None,
        listen: Listener = unheard,
    ) -> AsyncIterator[AsyncLiveFace]:
        """Open a live session on a rig, and yield its face as soon as it is ready.

        ``source`` is what its frames are: weights, markers, points or landmarks; ``captures`` may
        have a marker set; ``listen`` is called with what the session says. The session ends with
        the block, and its takes are files of the job of the same id then.
        """
        opened = await self._create(
            "/v1/live",
            OpenedSession,
            rig_id=rig if isinstance(rig, str) else rig.id,
            source=source,
            **by_origin(captures),
            options=options,
        )
        face = AsyncLiveFace(opened.id, _ServiceLine(self, opened.id), self._options, listen)
        try:
            await face.open(await self._open_socket(opened.url))
            yield face
        finally:
            with async_last_words(self._options.timeout_s):
                await face.close()
                await self.end_live(opened.id)

    @asynccontextmanager
    async def join_live(
        self, session_id: str, *, watch: bool = True, listen: Listener = unheard
    ) -> AsyncIterator[AsyncLiveFace]:
        """Connect to a session that somebody opened, to ``watch`` it or in its station's place."""
        line = _ServiceLine(self, session_id, watch)
        face = AsyncLiveFace(session_id, line, self._options, listen)
        try:
            ticket = await self.live_ticket(session_id, watch=watch)
            await face.open(await self._open_socket(ticket.url))
            yield face
        finally:
            await face.close()

    async def live_sessions(self, **filters: str | None) -> list[LiveSession]:
        """Return live sessions, newest first, filtered by rig_id or state."""
        return await self._list("/v1/live", LiveSession, **filters)

    async def live_session(self, session_id: str) -> LiveSession:
        """Return a live session as it stands."""
        return await self._get(f"/v1/live/{session_id}", LiveSession)

    async def live_ticket(self, session_id: str, *, watch: bool = False) -> LiveTicket:
        """Return a ticket for one more connection to a session."""
        return await self._create(f"/v1/live/{session_id}/tickets", LiveTicket, watch=watch)

    async def end_live(self, session_id: str) -> LiveSession:
        """End a session and wait until its takes are stored."""
        response = await self._request("DELETE", f"/v1/live/{session_id}", through=True)
        return LiveSession.read(read_json(response))

    async def _open_socket(self, url: str) -> AsyncSocket:
        proxy = describe_proxy(self._proxy)
        return await AsyncSocket.open(address_of(self._url, url), self._authority, proxy)


class AsyncLine(Protocol):
    """The way to a session: a face connects by it, again where a connection broke."""

    async def connect(self) -> AsyncSocket:
        """Return a new connection; raises :class:`ApiError`."""

    async def error(self) -> dict[str, Any] | None:
        """Return the error that the session has ended with, if it has."""


class _ServiceLine:
    """The way to a session of a service, by a new ticket each time."""

    def __init__(self, client: AsyncLiveSessions, session_id: str, watch: bool = False) -> None:
        self._client = client
        self._id = session_id
        self._watch = watch

    async def connect(self) -> AsyncSocket:
        """Connect by a new ticket."""
        ticket = await self._client.live_ticket(self._id, watch=self._watch)
        return await self._client._open_socket(ticket.url)

    async def error(self) -> dict[str, Any] | None:
        """Return the error of the session's job."""
        return (await self._client.live_session(self._id)).error


class AsyncLiveFace:
    """The face of a live session: frames go to it, and faces come back.

    Where a connection breaks ``line`` makes another; frames meanwhile are lost. One task may send
    while another receives. ``ready`` is what the session said when it was: the ``layout`` of its
    frames, ``expects``, its ``sliders`` and ``muscles``. ``takes`` and ``faults`` are what it said
    of takes and of frames that it could not use.
    """

    def __init__(
        self, session_id: str, line: AsyncLine, options: ClientOptions, listen: Listener = unheard
    ) -> None:
        self.id = session_id
        self.ready: dict[str, Any] = {}
        self.takes: list[dict[str, Any]] = []
        self.faults: deque[dict[str, Any]] = deque(maxlen=MOST_FAULTS)
        self._line = line
        self._options = options
        self._listen = listen
        self._socket: AsyncSocket | None = None
        self._mending = AsyncLock()
        self._number = 0

    async def open(self, socket: AsyncSocket) -> None:
        """Take a first connection, and wait until the session is ready."""
        self._socket = socket
        until = time.monotonic() + self._options.live_ready_s
        while not self.ready:
            if time.monotonic() > until:
                detail = f"the session is not ready after {self._options.live_ready_s:g} s"
                raise ApiError({"code": UNREACHABLE, "detail": detail})
            await self._take(self._options.live_frame_s)

    async def send(self, numbers: Numbers, seconds: float | None = None) -> int:
        """Send a frame; return its number.

        ``seconds`` is when it was captured, by a clock of the station's; without it, now.
        """
        self._number += 1
        moment = time.monotonic() if seconds is None else seconds
        expects = self.ready.get("expects") or {}
        await self._pass_on(pack_frame(self._number, moment, numbers, expects))
        return self._number

    async def receive(self, timeout: float | None = None) -> LiveFrame | None:
        """Return the next face; None: there is none within ``timeout`` seconds.

        Raises :class:`ApiError` when the session is over: its error, or ``client.ended``.
        """
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            left = None if until is None else max(until - time.monotonic(), 0.0)
            if (frame := await self._take(left)) is not None:
                return frame
            if until is not None and time.monotonic() >= until:
                return None

    async def track(
        self, frames: AsyncIterable[Numbers | Timed], *, ahead: int = 1
    ) -> AsyncIterator[LiveFrame]:
        """Send frames and yield the face that follows each.

        As many as ``ahead`` are on their way at a time. A frame whose answer does not come is
        passed over.
        """
        seen = 0
        async for each in frames:
            timed = each if isinstance(each, Timed) else Timed(time.monotonic(), each)
            sent = await self.send(timed.numbers, timed.seconds)
            async for face in self._until(seen, sent - ahead + 1):
                seen = face.number
                yield face
        async for face in self._until(seen, self._number):
            yield face

    async def _until(self, seen: int, number: int) -> AsyncIterator[LiveFrame]:
        """Yield faces until that of a frame, or a later one's, has come or does not come."""
        while seen < number:
            face = await self.receive(self._options.live_frame_s)
            if face is None:
                return
            if seen < face.number <= self._number:  # not one of the station's before
                seen = face.number
                yield face

    async def record(self, name: str) -> None:
        """Begin to record a take."""
        await self.tell({"record": name})

    async def tell(self, wish: Mapping[str, Any]) -> None:
        """Ask for something without waiting: ``record``, ``stop`` or ``end``."""
        await self._pass_on(json.dumps(wish))

    async def stop(self, timeout: float = 30.0) -> dict[str, Any]:
        """End the take; return what the session says of it: name, file, frames, seconds."""
        known = len(self.takes)
        await self.tell({"stop": True})
        until = time.monotonic() + timeout
        while len(self.takes) == known:
            if time.monotonic() > until:
                detail = f"the session said nothing of the take within {timeout:g} s"
                raise ApiError({"code": UNREACHABLE, "detail": detail})
            await self._take(self._options.live_frame_s)
        return self.takes[-1]

    async def close(self) -> None:
        """Close the connection; the session goes on."""
        socket = self._socket
        self._socket = None
        if socket is not None:
            with suppress(ApiError):
                await socket.close()

    async def _take(self, timeout: float | None) -> LiveFrame | None:
        """Return the next message if it is a frame; words are noted."""
        socket = self._connected()
        try:
            message = await socket.receive(timeout)
        except ApiError as error:
            await self._come_back(socket, error)
            return None
        if message is None:
            return None
        if isinstance(message, bytes):
            return read_frame(message, self.ready.get("layout") or ())
        words = json.loads(message)
        if words.get("type") == "ended":
            self._listen(words)
            detail = f"the session has ended: {words.get('reason')}"
            raise ApiError(await self._line.error() or {"code": ENDED, "detail": detail})
        self._note(words)
        return None

    def _note(self, words: dict[str, Any]) -> None:
        kind = words.get("type")
        self._listen(words)
        if kind == "ready":
            self.ready = words
        elif kind == "take":
            self.takes.append(words)
        elif kind == "fault":
            self.faults.append(words)

    async def _pass_on(self, message: bytes | str) -> None:
        while True:
            socket = self._connected()
            try:
                await socket.send(message)
                return
            except ApiError as error:
                await self._come_back(socket, error)
                if isinstance(message, bytes):
                    return  # a frame may be lost, a wish may not

    def _connected(self) -> AsyncSocket:
        if self._socket is None:
            raise ApiError({"code": ENDED, "detail": "the connection was closed here"})
        return self._socket

    async def _come_back(self, socket: AsyncSocket, error: ApiError) -> None:
        """Connect anew after a connection broke; raises an error that lasts."""
        is_broken = error.code == CLOSED and error.problem.get("close") not in FOR_GOOD
        if not is_broken and error.code != UNREACHABLE:
            raise error
        async with self._mending:
            if self._socket is not socket:  # another task has mended it, or closed it
                return
            with suppress(ApiError):
                await socket.close()
            backoff = Backoff(self._options)
            while self._socket is socket:
                try:
                    self._socket = await self._line.connect()
                except ApiError as again:
                    await anyio.sleep(backoff.pause_if_transient(again))
