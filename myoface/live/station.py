"""Run a live session at a station: frames of a source go in, followed faces go to the sinks.

Of frames that come faster than they can be sent the newest counts, and the others are counted as
dropped, unless the source waits for them (lines on standard input).
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import anyio

from myoface.live.faces import Face
from myoface.live.readings import Expected, Reading, ReadingError

Given = Reading | Mapping[str, Any]  # a frame, or a control that a source asks for


class Session(Protocol):
    """A session that follows frames: one of a service, or one in this process."""

    async def send(self, number: int, seconds: float, numbers: bytes) -> None:
        """Give it a frame."""

    async def control(self, said: Mapping[str, Any]) -> None:
        """Tell it to record, to stop recording, or to end."""

    def received(self) -> AsyncIterator[Face | dict[str, Any]]:
        """Yield what it says, the ready message before any face, until it has ended."""


class Sink(Protocol):
    """Where followed faces go."""

    def face(self, face: Face, latency_ms: float | None) -> None:
        """Take a face; the latency is from sending its frame to now."""

    def said(self, message: Mapping[str, Any]) -> None:
        """Take another message of the session's."""


@dataclass(frozen=True)
class StationOptions:
    """How long a station waits; in s."""

    last_s: float = 2.0  # for the face of the last frame
    end_s: float = 30.0  # for a session to end, with its take written
    most_sent: int = 4096  # frames whose faces are waited for
    latency_step_ms: float = 0.1  # latencies are told to this


@dataclass
class Tally:
    """What became of a station's frames."""

    sent: int = 0
    followed: int = 0
    dropped_here: int = 0  # before they were sent
    dropped: int = 0  # by the session, that it said
    refused: int = 0  # frames of another form than the session's
    first_refusal: str | None = None
    error_mm: tuple[float, float] = (float("nan"), float("nan"))
    takes: list[Mapping[str, Any]] = field(default_factory=list)
    ended: str | None = None
    latencies: Counter[int] = field(default_factory=Counter)  # by steps

    def latency_ms(self, share: float, options: StationOptions) -> float | None:
        """Return the latency in ms that this share of faces was within; None without any."""
        wanted = share * self.latencies.total()
        passed = 0
        for step in sorted(self.latencies):
            passed += self.latencies[step]
            if passed >= wanted:
                return step * options.latency_step_ms
        return None


class Station:
    """One run of a session; ``tally`` says what has become of it so far.

    ``waits`` is for a source whose frames can wait: each is sent.
    """

    def __init__(
        self,
        session: Session,
        sinks: Sequence[Sink],
        *,
        record: str | None = None,
        waits: bool = False,
        options: StationOptions = StationOptions(),
    ) -> None:
        self.tally = Tally()
        self._session = session
        self._sinks = sinks
        self._record = record
        self._waits = waits
        self._options = options
        self._sent: OrderedDict[int, float] = OrderedDict()  # number -> when, by our clock
        self._newest: Given | None = None
        self._is_recording = False
        self._stopping = anyio.Event()
        self._ready = anyio.Event()
        self._expected: Expected | None = None

    def stop(self) -> None:
        """End the run as if the source had ended: the take is stored."""
        self._stopping.set()

    async def run(self, source: AsyncIterator[Given]) -> Tally:
        """Follow what the source yields until it or the session ends; returns the tally.

        Raises what the session raises.
        """
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._give_and_end, source, tasks.cancel_scope)
            async for message in self._session.received():
                if isinstance(message, Face):
                    self._take_face(message)
                else:
                    self._take(message)
                if self.tally.ended is not None:
                    break
            tasks.cancel_scope.cancel()
        return self.tally

    async def _give_and_end(self, source: AsyncIterator[Given], scope: anyio.CancelScope) -> None:
        await self._ready.wait()
        if self._record is not None:
            await self._tell({"record": self._record})
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(self._stop_at, tasks.cancel_scope)
            if self._waits:
                async for given in source:
                    await self._give(given)
            else:
                await self._give_newest(source)
            tasks.cancel_scope.cancel()
        with anyio.move_on_after(self._options.last_s):
            while self._sent:
                await anyio.sleep(self._options.last_s / 100)
        if self._is_recording:
            await self._tell({"stop": True})
        await self._tell({"end": True})
        await anyio.sleep(self._options.end_s)
        scope.cancel()

    async def _stop_at(self, scope: anyio.CancelScope) -> None:
        await self._stopping.wait()
        scope.cancel()

    async def _give_newest(self, source: AsyncIterator[Given]) -> None:
        """Send the newest of what comes while another is on its way."""
        came = anyio.Event()
        is_over = False

        async def read() -> None:
            nonlocal came, is_over
            async for given in source:
                if isinstance(self._newest, Reading):
                    self.tally.dropped_here += 1
                self._newest = given
                came.set()
            is_over = True
            came.set()

        async with anyio.create_task_group() as tasks:
            tasks.start_soon(read)
            while not is_over or self._newest is not None:
                await came.wait()
                came = anyio.Event()
                given, self._newest = self._newest, None
                if given is not None:
                    await self._give(given)

    async def _give(self, given: Given) -> None:
        if not isinstance(given, Reading):
            await self._tell(given)
            return
        assert self._expected is not None, "the session is ready"
        try:
            numbers = self._expected.numbers(given)
        except ReadingError as error:
            self.tally.refused += 1
            self.tally.first_refusal = self.tally.first_refusal or str(error)
            return
        number = self.tally.sent
        self.tally.sent += 1
        self._sent[number] = time.monotonic()
        if len(self._sent) > self._options.most_sent:
            self._sent.popitem(last=False)
        await self._session.send(number, given.seconds, numbers)

    async def _tell(self, control: Mapping[str, Any]) -> None:
        if "record" in control:
            self._is_recording = True
        elif "stop" in control:
            self._is_recording = False
        elif "end" in control:
            self.stop()
        await self._session.control(control)

    def _take_face(self, face: Face) -> None:
        at = self._sent.get(face.number)
        latency = None if at is None else 1e3 * (time.monotonic() - at)
        while self._sent and next(iter(self._sent)) <= face.number:  # older ones were dropped
            self._sent.popitem(last=False)
        tally = self.tally
        tally.followed += 1
        tally.dropped = face.dropped
        tally.error_mm = face.error_mm
        if latency is not None:
            tally.latencies[round(latency / self._options.latency_step_ms)] += 1
        for sink in self._sinks:
            sink.face(face, latency)

    def _take(self, message: dict[str, Any]) -> None:
        kind = message.get("type")
        if kind == "ready":
            self._expected = Expected.of(message)
            self._ready.set()
        elif kind == "take":
            self.tally.takes.append(message)
        elif kind == "ended":
            self.tally.ended = str(message.get("reason", ""))
        for sink in self._sinks:
            sink.said(message)
