"""The bridge of a live session: between its streams in the broker and its solver process.

Frames never pile up. The solver has a few at a time, a few more wait here, and where more come
the oldest go and are counted. A broker that is away is asked again and again: the session goes on
when it is back.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import structlog

from service.queue.streams import KEPT_SECONDS, MOST_OUT, TOLD, Answered, Fields, Inbox, Names, Sent
from service.queue.wakeups import AWAY, connect
from solver.kinds.live_channel import Channel, ChannelClosedError
from solver.kinds.live_messages import FollowedFrame, Message, MessageError
from solver.kinds.live_session import REPORT, VIEW_FILE

RESUME = Message(b'{"resume": true}', is_text=True)

log = structlog.get_logger()


@dataclass(frozen=True)
class BridgeOptions:
    """Bounds of a bridge; times in s."""

    in_solver: int = 32  # most frames sent to the solver and not yet answered
    silent: float = 0.5  # without any answer, after which one more is sent anyway
    asks: float = 0.5  # how long the broker is asked for news at a time
    rests: float = 0.2  # after the broker failed
    looks_back: int = 16  # answers among which the last frame is looked for
    farewell: float = 2.0  # until the threads have ended
    keeps: float = 60.0  # what an ended session said, for who asks then


class Bridge:
    """Passes messages on for one attempt at a session, by three threads, until it is stopped."""

    def __init__(
        self,
        channel: Channel,
        broker_url: str,
        session_id: str,
        attempt: int,
        options: BridgeOptions = BridgeOptions(),
    ) -> None:
        self._channel = channel
        self._names = Names.of(session_id)
        self._attempt = attempt
        self._options = options
        patience = 1 + self._options.asks
        self._reading, self._writing = (
            connect(broker_url, socket_timeout=patience) for _ in range(2)
        )
        self._stopping = threading.Event()
        self._changed = threading.Condition()
        self._inbox = Inbox()
        self._in_solver: deque[int] = deque()  # numbers of frames without an answer
        self._answered = time.monotonic()
        self._told: dict[Any, Any] = {}  # the last words of each type
        self._unsent: list[Message] = []  # words that the broker has yet to get
        self._is_told = False  # whether it has those that are to be kept
        self._kept = 0.0  # when it was told to keep them
        self._left: list[str] = []
        self._threads = [
            threading.Thread(target=work, name=f"live-{work.__name__.strip('_')}", daemon=True)
            for work in (self._read, self._pass_in, self._pass_out)
        ]

    def start(self) -> None:
        """Start the threads; a later attempt gets the last frame that the one before answered."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop: the solver has ended."""
        self._stopping.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            thread.join(self._options.farewell)
        self._channel.close()
        if "ended" in self._told:
            with suppress(*AWAY):
                self._keep_for(round(self._options.keeps))
        for client in (self._reading, self._writing):
            client.close()

    def left(self) -> list[str]:
        """Return the names of files that are there by now: takes, their list, and the view."""
        return list(self._left)

    def _read(self) -> None:
        """Read what the station sends, from the broker."""
        last, newest = self._begin()
        while not self._stopping.is_set():
            try:
                found: Any = self._reading.xread(
                    {self._names.into: last}, block=round(1000 * self._options.asks)
                )
            except AWAY as error:
                self._rest(error)
                continue
            with self._changed:
                came = [(place, Sent.read(fields)) for place, fields in _entries(found)]
                for place, sent in came:
                    if not sent.is_frame or _order(place) > _order(newest):
                        self._inbox.add(sent)
                self._changed.notify_all()
            last = next((place for place, _ in reversed(came)), last)
            if any(not sent.is_frame for _, sent in came):
                with suppress(*AWAY):
                    self._reading.set(self._names.read, last, ex=KEPT_SECONDS)

    def _begin(self) -> tuple[bytes, bytes]:
        """Give the solver the last frame of the attempt before.

        Return after which entry to read on, and up to which one of these words alone count: what
        was said while nobody held the session is heard, frames of that time are gone.
        """
        names = self._names
        while self._attempt > 1 and not self._stopping.is_set():
            try:
                newest: Any = self._reading.xrevrange(names.out, count=self._options.looks_back)
                came: Any = self._reading.xrevrange(names.into, count=1)
                heard: Any = self._reading.get(names.read)
            except AWAY as error:
                self._rest(error)
                continue
            answers = [Answered.read(fields).message for _, fields in newest]
            frame = next((each for each in answers if not each.is_text), None)
            if frame is not None:
                with suppress(ChannelClosedError):
                    self._channel.send(RESUME)
                    self._channel.send(frame)
            return heard or b"0", next((place for place, _ in came), b"0")
        return b"0", b"0"

    def _pass_in(self) -> None:
        """Give the solver what came, a few frames at a time."""
        while (sent := self._next()) is not None:
            try:
                self._channel.send(sent.message)
            except ChannelClosedError:
                return

    def _next(self) -> Sent | None:
        """Wait for a message that the solver may have; None: there is none any more."""
        with self._changed:
            while not self._stopping.is_set():
                first = self._inbox.first
                if first is not None and self._may_have(first):
                    sent = self._inbox.take()
                    if sent.is_frame:
                        self._in_solver.append(sent.message.number)
                    return sent
                self._changed.wait(self._options.silent)
        return None

    def _may_have(self, sent: Sent) -> bool:
        is_silent = time.monotonic() - self._answered > self._options.silent
        if is_silent:
            self._answered = time.monotonic()
        return not sent.is_frame or len(self._in_solver) < self._options.in_solver or is_silent

    def _pass_out(self) -> None:
        """Send on what the solver says, to its last word."""
        while True:
            try:
                message = self._channel.receive(self._options.asks)
            except (ChannelClosedError, MessageError):
                return
            if message is None:
                if self._stopping.is_set():
                    return
                self._publish(None)
                continue
            with self._changed:
                self._settle(message.number)
                self._answered = time.monotonic()
                self._changed.notify_all()
            if message.is_text:
                self._note(message)
            elif self._inbox.dropped:
                message = self._count(message)
            self._publish(message)

    def _settle(self, number: int) -> None:
        """Count what was given up to a frame's number as answered: one answer is for all of it."""
        if number in self._in_solver:
            while self._in_solver.popleft() != number:
                pass

    def _note(self, message: Message) -> None:
        """Remember what somebody who joins later must be told."""
        said = message.words
        kind = said.get("type")
        if kind in TOLD:
            self._told[kind] = message.data
        if kind == "ready":
            self._told.pop("preparing", None)
            self._left.append(VIEW_FILE)
        if kind == "take":
            self._told.pop("recording", None)
            if isinstance(file := said.get("file"), str):
                self._left += [file, REPORT]
        self._is_told = False

    def _count(self, message: Message) -> Message:
        """Add the frames that never came to the solver to those that it dropped itself."""
        try:
            frame = FollowedFrame.unpack(message.data)
        except MessageError:
            return message
        return Message(replace(frame, dropped=frame.dropped + self._inbox.dropped).pack())

    def _publish(self, message: Message | None) -> None:
        """Add a message to the stream, after words that could not be added before."""
        if message is not None and (message.is_text or not self._unsent):
            self._unsent.append(message)
        try:
            if self._unsent or not self._is_told:
                self._send()
            if time.monotonic() - self._kept > KEPT_SECONDS / 4:
                self._keep_for(KEPT_SECONDS)
                self._kept = time.monotonic()
        except AWAY as error:
            self._unsent = [each for each in self._unsent if each.is_text][-MOST_OUT:]
            self._rest(error)

    def _send(self) -> None:
        pipe = self._writing.pipeline(transaction=False)
        for each in self._unsent:
            fields = Answered(each, self._attempt).fields()
            pipe.xadd(self._names.out, fields, maxlen=MOST_OUT, approximate=False)
        if not self._is_told:
            pipe.delete(self._names.told)
            if self._told:
                pipe.hset(self._names.told, mapping=self._told)
            self._kept = 0.0
        pipe.execute()
        self._is_told = True
        self._unsent.clear()

    def _keep_for(self, seconds: int) -> None:
        for key in (self._names.out, self._names.told):
            self._writing.expire(key, seconds)

    def _rest(self, error: Exception) -> None:
        """Leave a broker alone that did not answer; perhaps it has forgotten all when it does."""
        self._is_told = False
        log.warning("broker.unreachable", error=str(error))
        self._stopping.wait(self._options.rests)


def _order(place: bytes) -> tuple[int, ...]:
    """Return what tells which of two entries of a stream is the later one."""
    return tuple(map(int, place.split(b"-")))


def _entries(found: Any) -> list[tuple[bytes, Fields]]:
    """Return the entries of the one stream that was read."""
    return found[0][1] if found else []
