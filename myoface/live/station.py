"""Run a live session at a station: frames of a source go in, followed faces go to the sinks.

Of frames that come faster than they can be sent the newest counts, and the others are counted as
dropped, unless the source waits for them (lines on standard input).
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import nan
from typing import Any, Protocol

import anyio

from myoface.client import LiveFrame, Timed
from myoface.client.aio_live import ENDED, AsyncLiveFace
from myoface.errors import ApiError

Given = Timed | Mapping[str, Any]  # a frame, or a wish such as {"record": "take_1"}

OVER = (ENDED, "live.over")  # errors that tell the session's end


class Sink(Protocol):
    """Where followed faces go."""

    def face(self, frame: LiveFrame, latency_ms: float | None) -> None:
        """Take a face; the latency is from sending its frame to now."""

    def said(self, message: Mapping[str, Any]) -> None:
        """Take what the session says in words: the ready message comes before any face."""


@dataclass(frozen=True)
class StationOptions:
    """How long a station waits; in s."""

    last_s: float = 2.0  # for the face of the last frame
    take_s: float = 30.0  # for a take to be written
    ahead: int = 4  # frames on their way, of a source that waits
    pause_s: float = 0.02  # between two looks at these
    most_sent: int = 4096  # frames whose faces are waited for
    latency_step_ms: float = 0.1  # latencies are told to this


STATION = StationOptions()


@dataclass
class Tally:
    """What became of a station's frames."""

    sent: int = 0
    followed: int = 0
    dropped_here: int = 0  # before they were sent
    dropped: int = 0  # by the session, that it said
    refused: int = 0  # frames of no form that could be sent
    faults: int = 0  # that the session told
    first_fault: str | None = None  # of either
    error_mm: tuple[float, float] = (nan, nan)  # running error, p50 and p95
    takes: list[Mapping[str, Any]] = field(default_factory=list)
    ended: str | None = None  # why the session did, where the station did not end it
    latencies: Counter[int] = field(default_factory=Counter)  # by steps

    def latency_ms(self, share: float, options: StationOptions = STATION) -> float:
        """Return the latency in ms that this share of faces was within; NaN without any."""
        wanted = share * self.latencies.total()
        passed = 0
        for step in sorted(self.latencies):
            passed += self.latencies[step]
            if passed >= wanted:
                return step * options.latency_step_ms
        return nan

    def fault(self, message: str) -> None:
        """Note what was wrong with a frame."""
        self.first_fault = self.first_fault or message


class Station:
    """One run of a session; ``tally`` says what has become of it so far.

    ``waits`` is for a source whose frames can wait: each is sent. :meth:`said` is the listener of
    the face that is run.
    """

    def __init__(
        self,
        sinks: Sequence[Sink],
        *,
        record: str | None = None,
        waits: bool = False,
        options: StationOptions = STATION,
    ) -> None:
        self.tally = Tally()
        self._sinks = sinks
        self._record = record
        self._waits = waits
        self._options = options
        self._sent: OrderedDict[int, float] = OrderedDict()  # number -> when, by our clock
        self._followed = anyio.Event()
        self._is_recording = False
        self._stopping = anyio.Event()

    def stop(self) -> None:
        """End the run as if the source had ended: the take is stored."""
        self._stopping.set()

    @property
    def is_stopping(self) -> bool:
        """Whether it was stopped."""
        return self._stopping.is_set()

    def said(self, message: dict[str, Any]) -> None:
        """Take what the session says in words."""
        kind = message.get("type")
        if kind == "take":
            self._is_recording = False
            if message.get("file"):  # one without frames has none
                self.tally.takes.append(message)
        elif kind == "recording":
            self._is_recording = True
        elif kind == "fault":
            self.tally.faults += 1
            self.tally.fault(str(message.get("message")))
        elif kind == "ended":
            self.tally.ended = str(message.get("reason"))
        for sink in self._sinks:
            sink.said(message)

    async def run(self, face: AsyncLiveFace, source: AsyncIterator[Given]) -> Tally:
        """Follow what the source yields until it or the session ends; returns the tally.

        Raises what the source raises, and :class:`ApiError` where the line breaks for good.
        """
        with alone():
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(self._receive, face, tasks.cancel_scope)
                await self._give_all(face, source)
                await self._finish(face)
                tasks.cancel_scope.cancel()
        return self.tally

    async def _receive(self, face: AsyncLiveFace, scope: anyio.CancelScope) -> None:
        """Take faces until the session ends."""
        try:
            while True:
                frame = await face.receive()
                if frame is not None:
                    self._take(frame)
        except ApiError as error:
            if error.code not in OVER:
                raise
        scope.cancel()

    async def _give_all(self, face: AsyncLiveFace, source: AsyncIterator[Given]) -> None:
        """Send what the source yields until it ends, or the station is stopped."""
        if self._record is not None:
            await face.tell({"record": self._record})
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._stop_at, tasks.cancel_scope)
            if self._waits:
                async for given in source:
                    await self._give(face, given)
            else:
                await self._give_newest(face, source)
            tasks.cancel_scope.cancel()

    async def _stop_at(self, scope: anyio.CancelScope) -> None:
        await self._stopping.wait()
        scope.cancel()

    async def _give_newest(self, face: AsyncLiveFace, source: AsyncIterator[Given]) -> None:
        """Send the newest of what comes while another is on its way."""
        newest: Given | None = None
        came = anyio.Event()
        is_over = False

        async def read() -> None:
            nonlocal newest, is_over
            async for given in source:
                self.tally.dropped_here += newest is not None
                newest = given
                came.set()
            is_over = True
            came.set()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            while not is_over or newest is not None:
                await came.wait()
                came = anyio.Event()
                given = newest
                newest = None
                if given is not None:
                    await self._give(face, given)

    async def _give(self, face: AsyncLiveFace, given: Given) -> None:
        if not isinstance(given, Timed):
            await face.tell(given)
            if "end" in given:
                self.stop()
            return
        began = time.monotonic()
        try:
            number = await face.send(given.numbers, given.seconds)
        except (TypeError, ValueError, OverflowError) as error:
            self.tally.refused += 1
            self.tally.fault(str(error))
            return
        self.tally.sent += 1
        self._sent[number] = began
        if len(self._sent) > self._options.most_sent:
            self._sent.popitem(last=False)
        if self._waits:
            with anyio.move_on_after(self._options.last_s):
                while len(self._sent) >= self._options.ahead:
                    self._followed = anyio.Event()
                    await self._followed.wait()

    async def _finish(self, face: AsyncLiveFace) -> None:
        """Wait for the last face, and for the take to be written."""
        options = self._options
        with anyio.move_on_after(options.last_s):
            while self._sent:
                await anyio.sleep(options.pause_s)
        await face.tell({"stop": True})
        with anyio.move_on_after(options.take_s):
            while self._is_recording:
                await anyio.sleep(options.pause_s)

    def _take(self, frame: LiveFrame) -> None:
        self._followed.set()
        tally = self.tally
        at = self._sent.get(frame.number)
        latency = None if at is None else 1e3 * (time.monotonic() - at)
        while self._sent and next(iter(self._sent)) <= frame.number:  # older ones were dropped
            self._sent.popitem(last=False)
        tally.followed += 1
        tally.dropped = frame.dropped
        tally.error_mm = frame.error_p50_mm, frame.error_p95_mm
        if latency is not None:
            tally.latencies[round(latency / self._options.latency_step_ms)] += 1
        for sink in self._sinks:
            sink.face(frame, latency)


@contextmanager
def alone() -> Iterator[None]:
    """Raise the first error of tasks as it is, not in a group."""
    try:
        yield
    except BaseExceptionGroup as group:
        error: BaseException = group
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        raise error from group
