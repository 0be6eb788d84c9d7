"""One connection to a live session: what it sends goes in, what the session answers comes out.

Messages are passed on unread. Nothing piles up on the way: a station that sends too fast has its
messages dropped and counted, and of what waits for a client that reads slowly the newest is sent.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

import structlog
from anyio import CancelScope, Event, create_task_group, fail_after, sleep, to_thread
from sqlalchemy import or_, select
from sqlalchemy.exc import SQLAlchemyError
from starlette.websockets import WebSocket, WebSocketDisconnect

from service.live.broker import LiveBroker
from service.live.tickets import Ticket
from service.queue.states import FINAL
from service.queue.streams import LARGEST, TOLD, Answered, Inbox, Names, Sent
from service.queue.wakeups import AWAY
from service.store.database import Store, clock
from service.store.models import ApiKey, Job
from solver.kinds.live_messages import Message

# Codes with which a connection is closed; after any other one a client comes back with a new ticket
ENDED = 1000
TOO_LARGE = 1009
TAKEN_OVER = 4001
REVOKED = 4003

TOO_FAST = "live.too_fast"

log = structlog.get_logger()


@dataclass(frozen=True)
class RelayOptions:
    """Bounds of a connection; times in s."""

    rate: float = 500.0  # messages a second that a station may send
    burst: float = 100.0  # at once
    behind: int = 8  # frames, of those that wait for a slow reader, that it gets
    rests: float = 0.2  # after the broker failed
    looks: float = 2.0  # between two looks whether the session is over, and the key still good
    sends: float = 60.0  # for a client that takes nothing


class RelayedClient:
    """A client's connection to a session, with its ticket, until either ends it."""

    def __init__(
        self,
        socket: WebSocket,
        ticket: Ticket,
        broker: LiveBroker,
        store: Store,
        options: RelayOptions,
    ) -> None:
        self._socket = socket
        self._ticket = ticket
        self._broker = broker
        self._store = store
        self._options = options
        self._names = Names.of(ticket.session_id)
        self._name = secrets.token_urlsafe(12)
        self._tokens = options.burst
        self._at = time.monotonic()
        self._lost_words = 0  # that came too fast, and of which the client has yet to hear
        self._attempt = 0
        self._inbox = Inbox()
        self._came = Event()

    async def serve(self) -> None:
        """Pass messages on until the connection ends."""
        try:
            async with create_task_group() as tasks:
                for work in (self._receive, self._pass_in, self._send, self._look):
                    tasks.start_soon(_and_then_cancel, work, tasks.cancel_scope)
        except* (WebSocketDisconnect, TimeoutError):
            log.info("live.disconnected", job_id=self._ticket.session_id)

    async def take_seat(self) -> None:
        """Be the station's connection from now on."""
        if self._ticket.is_station:
            await self._broker.take_seat(self._names, self._name)

    async def _receive(self) -> None:
        """Take what the client sends; of one that only watches, nothing."""
        number = 0
        while True:
            came = await self._socket.receive()
            if came["type"] == "websocket.disconnect":
                return
            if not self._ticket.is_station:
                continue
            number += 1
            text = came.get("text")
            message = Message(came["bytes"]) if text is None else Message(text.encode(), True)
            if len(message.data) > LARGEST:
                await self._close(TOO_LARGE, f"a message has {LARGEST} bytes at most")
                return
            # by words: what a person sends is no frame unless it has a number
            is_frame = text is None or '"number"' in text
            if not self._may_send():
                self._lost_words += not is_frame  # frames are counted by their numbers
            else:
                self._inbox.add(Sent(message, number, self._name, is_frame))
                self._came.set()

    async def _pass_in(self) -> None:
        """Give the broker what came, the newest if it is slow."""
        while True:
            await self._came.wait()
            self._came = Event()
            while self._inbox.first is not None:
                try:
                    is_mine = await self._broker.add(self._names, self._inbox.take())
                except AWAY as error:
                    await self._rest(error)
                    continue
                if not is_mine:
                    await self._close(TAKEN_OVER, "another connection is the station's now")
                    return

    def _may_send(self) -> bool:
        options = self._options
        moment = time.monotonic()
        self._tokens += (moment - self._at) * options.rate
        self._tokens = min(self._tokens, options.burst)
        self._at = moment
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True

    async def _send(self) -> None:
        """Send what the session says: first what others have been told before."""
        last: bytes | None = None
        while True:
            try:
                if last is None:
                    last, told = await self._broker.told(self._names)
                    answers: Sequence[Answered] = [
                        Answered(Message(told[kind.encode()], True), 0)
                        for kind in TOLD
                        if kind.encode() in told
                    ]
                else:
                    last, answers = await self._broker.answers(self._names, last)
            except AWAY as error:
                await self._rest(error)
                continue
            await self._tell_lost()
            for message in self._newest(answers):
                await self._say(message)
                if message.words.get("type") == "ended":
                    await self._close(ENDED, "the session has ended")
                    return

    async def _tell_lost(self) -> None:
        """Say that words were lost, if some were: nobody else will answer them."""
        if self._lost_words:
            words = f"{self._lost_words} messages came too fast and are lost: send them again"
            fault = {"type": "fault", "code": TOO_FAST, "message": words, "number": None}
            self._lost_words = 0
            await self._say(Message.of(fault))

    def _newest(self, answers: Sequence[Answered]) -> list[Message]:
        """Return what is sent of answers that wait: all words, and the last frames."""
        self._attempt = max([self._attempt, *(each.attempt for each in answers)])
        own = [each.message for each in answers if each.attempt in (0, self._attempt)]
        frames = [place for place, message in enumerate(own) if not message.is_text]
        old = set(frames[: -self._options.behind])
        return [message for place, message in enumerate(own) if place not in old]

    async def _say(self, message: Message) -> None:
        with fail_after(self._options.sends):
            if message.is_text:
                await self._socket.send_text(message.data.decode(errors="replace"))
            else:
                await self._socket.send_bytes(message.data)

    async def _look(self) -> None:
        """See whether the session is over, the key revoked, or another one the station."""
        while True:
            await sleep(self._options.looks)
            try:
                end = await to_thread.run_sync(self._find_end, abandon_on_cancel=True)
                has_seat = not self._ticket.is_station or await self._broker.has_seat(
                    self._names, self._name
                )
            except (SQLAlchemyError, *AWAY) as error:
                log.warning("live.not_looked_at", error=str(error))
                continue
            if not has_seat:
                end = TAKEN_OVER, "another connection is the station's now"
            if end is not None:
                if end[0] == ENDED:
                    words = json.dumps({"type": "ended", "reason": end[1]})
                    await self._say(Message(words.encode(), True))
                await self._close(*end)
                return

    def _find_end(self) -> tuple[int, str] | None:
        """Return why the tables say that the connection has to end; None if it goes on."""
        with self._store.read() as session:
            state = session.scalar(select(Job.state).where(Job.id == self._ticket.session_id))
            ends = (ApiKey.revoked_at, ApiKey.expires_at)
            holds = [or_(end.is_(None), end > clock(session)) for end in ends]
            key = select(ApiKey.id).where(ApiKey.id == self._ticket.who.key_id, *holds)
            is_good = session.scalar(key) is not None
        if state is None or state in FINAL:
            return ENDED, "deleted" if state is None else state.value
        return None if is_good else (REVOKED, "the key was revoked")

    async def _rest(self, error: Exception) -> None:
        log.warning("broker.unreachable", error=str(error))
        await sleep(self._options.rests)

    async def _close(self, code: int, reason: str) -> None:
        await self._socket.close(code, reason)


async def _and_then_cancel(work: Callable[[], Awaitable[None]], scope: CancelScope) -> None:
    await work()
    scope.cancel()
