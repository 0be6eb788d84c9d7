"""The job that holds a live session."""

from __future__ import annotations

import json
import math
import time
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import InputError, SolveError
from solver.fitting.expression_basis import FILE as BASIS_FILE
from solver.jobs import Task
from solver.kinds.live_channel import Channel, ChannelClosedError
from solver.kinds.live_messages import (
    FOLLOWED,
    GIVEN,
    HELD,
    FollowedFrame,
    GivenFrame,
    Message,
    MessageError,
)
from solver.kinds.live_session import ENDING, PART, REPORT, VIEW_FILE, LiveSessionOptions
from solver.live.samples import FILE as SAMPLES_FILE
from solver.live.sent import FILE as TAKES_FILE
from solver.live.sent import gather_takes
from solver.live.session import LiveOptions, LiveSession
from solver.live.skin import FILE
from solver.live.takes import (
    LeftTake,
    SentFace,
    TakeWriter,
    check_name,
    check_room,
    drop_part,
    finish_part,
)
from solver.live.texts import describe_frame, read_frame
from solver.progress import Step
from solver.storage import write_json


@dataclass(frozen=True)
class LoopOptions:
    """Numbers of the loop that passes messages."""

    wait_s: float = 0.25  # for a message, at most, before the clock is looked at
    most_waiting: int = 64  # messages that are read before a frame is followed
    # newest of the frames that wait which are followed: a moment's stall costs none, and a source
    # that is too fast is never further behind
    most_behind: int = 3
    fault_s: float = 1.0  # between two faults of one code that are told
    progress_s: float = 5.0  # between two steps of the job's progress


LOOP = LoopOptions()
NO_TAKE = {"type": "take", "name": None, "file": None, "frames": 0, "seconds": 0.0}


def run(task: Task[LiveSessionOptions]) -> list[Path]:
    """Follow the frames of a session until it ends; takes, skin and report are left.

    Raises :class:`InputError` (``live.channel``) where there is no channel, as offline, and what
    opening a session raises.
    """
    if task.channel is None:
        message = "a live session needs a service that passes frames, or the command myoface live"
        raise InputError("live.channel", message)
    return _Loop(task, task.channel).hold()


class _Loop:
    """Holds one session: reads messages, follows frames, records takes."""

    def __init__(self, task: Task[LiveSessionOptions], channel: Channel) -> None:
        self._task = task
        self._channel = channel
        self._begin = self._last_frame = time.monotonic()
        self._dropped = 0
        self._ending: str | None = None
        self._take: TakeWriter | None = None
        self._takes: dict[str, dict[str, Any]] = {}  # by their files
        self._faults = _Faults(channel)
        self._shown = 0.0
        self._is_resuming = False
        self._waiting: deque[_Given] = deque()
        self._early: list[Message] = []  # that came before the session could begin

    def hold(self) -> list[Path]:
        """Hold the session and return the files that it leaves."""
        task = self._task
        self._rescue_takes()
        given = task.options
        options = LiveOptions(
            given.source,
            given.rate,
            given.smooth_hz,
            given.send_skin,
            given.check_seconds,
            resume=task.resume,
        )
        try:
            session = LiveSession.open(task.inputs, task.out, options, self._prepare)
        except _EndedError:
            return self._leave(None)
        try:
            self._tell(session.ready())
            self._begin = self._last_frame = time.monotonic()
            for message in self._early:
                self._take_message(session, message)
            while self._ending is None:
                self._turn(session)
        except (ChannelClosedError, MessageError):  # after one that is too long nothing is read
            self._ending = "closed"
        finally:
            session.close()
        return self._leave(session)

    def _turn(self, session: LiveSession) -> None:
        """Take what has come, and follow the newest frames of it."""
        message = self._channel.receive(LOOP.wait_s)
        read = 0
        while message is not None:
            self._take_message(session, message)
            read += 1
            message = self._channel.receive(0.0) if read < LOOP.most_waiting else None
        self._follow_waiting(session)
        self._look_at_clock(session)

    def _follow_waiting(self, session: LiveSession) -> None:
        """Follow the newest of the frames that wait; the take has all of them."""
        behind = max(len(self._waiting) - LOOP.most_behind, 0)
        self._dropped += behind
        for _ in range(behind):
            self._add_to_take(session, self._waiting.popleft())
        while self._waiting:
            given = self._waiting.popleft()
            try:
                followed, sample = session.step(given.frame, given.numbers, self._dropped)
            except (SolveError, np.linalg.LinAlgError) as error:  # ends neither session nor take
                message = f"frame {given.frame.number} cannot be followed: {error}"
                self._faults.tell("live.frame", message, given.frame.number)
                session.begin()
                self._add_to_take(session, given)
                continue
            sent = None
            if not followed.flags & HELD:
                told = followed.error_p50_mm, followed.error_p95_mm
                sent = SentFace(sample.sent, told)
            self._add_to_take(session, given, sent)
            if given.is_text:
                self._tell(describe_frame(followed, session))
            else:
                self._channel.send(Message(followed.pack()))

    def _add_to_take(
        self, session: LiveSession, given: _Given, sent: SentFace | None = None
    ) -> None:
        """Add a frame to the take that is being recorded, if there is one."""
        if self._take is None:
            return
        self._take.add(given.frame.seconds, given.numbers, sent)
        if self._take.is_full:
            message = "the take is as long as it may be"
            self._faults.tell("live.take_full", message, given.frame.number)
            self._stop(session)

    def _take_message(self, session: LiveSession, message: Message) -> None:
        """Take a message: a frame, or what a client wants."""
        try:
            if message.data.startswith(FOLLOWED) and not message.is_text:
                self._resume(session, FollowedFrame.unpack(message.data))
                return
            frame = (
                self._take_text(session, message.data)
                if message.is_text
                else GivenFrame.unpack(message.data)
            )
            if frame is None:
                return
            given = _Given(frame, session.read(frame), message.is_text)
        except MessageError as error:
            self._faults.tell("live.message", str(error), message.number)
            return
        except InputError as error:
            self._faults.tell(error.code, error.message, message.number)
            return
        self._last_frame = time.monotonic()
        self._waiting.append(given)

    def _take_text(self, session: LiveSession, data: bytes) -> GivenFrame | None:
        """Take JSON: a frame of numbers as people write them, or what is wanted."""
        said = _read_object(data)
        if "number" in said:
            return read_frame(said, session.source)
        if "record" in said:
            self._follow_waiting(session)
            self._record(session, said["record"])
        elif said.get("stop"):
            self._follow_waiting(session)
            if self._take is None:  # who waits for a take is to hear that there is none
                self._tell(NO_TAKE)
            self._stop(session)
        elif said.get("end"):
            self._ending = "asked"
        elif said.get("resume"):
            self._is_resuming = True  # the frame comes next
        else:
            names = ", ".join(sorted(map(str, said))) or "nothing"
            raise MessageError(
                f"a message says number, record, stop or end: this one says {names[:60]}"
            )
        return None

    def _resume(self, session: LiveSession, frame: FollowedFrame) -> None:
        """Go on from the frame that an earlier attempt followed last, if it was told before."""
        if not self._is_resuming:
            raise MessageError("a followed frame is the session's to send")
        self._is_resuming = False
        self._dropped = frame.dropped
        session.resume(frame)

    def _record(self, session: LiveSession, name: object) -> None:
        """Begin a take; one that is being recorded is stopped before."""
        self._stop(session)
        check_room([self._task.out / file for file in self._takes])
        source = session.options.source
        chosen = check_name(name, self._task.out, source)
        shape = (session.source.rows, session.source.width)
        labels = session.source.labels
        self._take = TakeWriter(self._task.out, chosen, source, labels, shape, session.modes)
        self._tell({"type": "recording", "name": chosen})

    def _stop(self, session: LiveSession | None) -> None:
        """End the take that is being recorded, if there is one."""
        if self._take is None:
            return
        name = self._take.name
        take = self._take.finish()
        self._take = None
        if take is None:
            self._tell({**NO_TAKE, "name": name})
            return
        told = {} if session is None else {"error_mm": _rounded(session.errors.told)}
        self._left(take, told)

    def _left(self, take: LeftTake, more: Mapping[str, Any]) -> None:
        """List a take and tell of it.

        The list is written before what was recorded goes: whenever a worker is killed, the next
        attempt finds the take in the one or the other.
        """
        self._takes[take.file] = {**asdict(take), **more}
        self._report({"takes": [*self._takes.values()]})
        drop_part(self._task.out, take)
        self._tell({"type": "take", **asdict(take)})

    def _report(self, report: Mapping[str, Any]) -> None:
        """Replace the report whole."""
        part = self._task.out / f".{REPORT}"
        write_json(part, report)
        part.replace(self._task.out / REPORT)

    def _look_at_clock(self, session: LiveSession) -> None:
        now = time.monotonic()
        given = self._task.options
        if self._ending is not None:
            return
        if now - self._last_frame > given.idle_seconds:
            self._ending = "idle"
        elif now - self._begin > given.max_seconds:
            self._ending = "limit"
        if now - self._shown > LOOP.progress_s:
            self._shown = now
            part = min((now - self._begin) / given.max_seconds, 1.0)
            words = f"{session.frames} frames"
            self._task.progress(Step("live", 0.1 + 0.85 * part, session.frames, message=words))

    def _prepare(self, phase: str, part: float) -> None:
        """Tell what is made before the session can begin.

        Frames that come are dropped, what is wanted is kept for the session.
        """
        self._tell({"type": "preparing", "phase": phase, "fraction": round(part, 3)})
        self._task.progress(Step(phase, 0.1 * part))
        while (message := self._channel.receive(0.0)) is not None:
            said = message.words
            if "end" in said:
                self._ending = "asked"
                raise _EndedError
            if "number" in said or message.data.startswith(GIVEN):
                self._dropped += 1
            elif len(self._early) < LOOP.most_waiting:
                self._early.append(message)

    def _tell(self, said: Mapping[str, Any]) -> None:
        self._channel.send(Message.of(said))

    def _rescue_takes(self) -> None:
        """List the takes of attempts before, and finish one that was being recorded."""
        out = self._task.out
        if not self._task.resume:
            return
        if (out / REPORT).is_file():
            listed = json.loads((out / REPORT).read_text(encoding="utf-8"))["takes"]
            self._takes = {take["file"]: take for take in listed}
        for part in sorted(out.glob(f"take_*{PART}")):
            take = finish_part(part)
            if take is not None:
                self._left(take, {"rescued": True})

    def _leave(self, session: LiveSession | None) -> list[Path]:
        """Finish what is being recorded, say the end, and write the report."""
        out = self._task.out
        reason = self._ending or "closed"
        self._task.progress(Step(ENDING, 0.96))
        with suppress(ChannelClosedError):
            while session is not None and self._waiting:  # of a channel that was closed meanwhile
                self._add_to_take(session, self._waiting.popleft())
            self._stop(session)
            self._tell({"type": "ended", "reason": reason})
        for left in out.glob(f".{SAMPLES_FILE}.*"):  # of full solves that were ended amid writing
            left.unlink(missing_ok=True)
        figures = {} if session is None else session.figures()
        seconds = round(time.monotonic() - self._begin, 1)
        report = {**figures, "dropped": self._dropped, "seconds": seconds, "ended": reason}
        self._report({**report, "faults": self._faults.counts, "takes": [*self._takes.values()]})
        gather_takes(out, None if session is None else session.modes)
        self._task.progress(Step("done", 1.0))
        made = [out / name for name in (FILE, VIEW_FILE, BASIS_FILE, TAKES_FILE, SAMPLES_FILE)]
        takes = [out / file for file in self._takes]
        return [out / REPORT, *(path for path in made if path.is_file()), *takes]


@dataclass(frozen=True)
class _Given:
    """A frame that has come; one of JSON is answered by JSON."""

    frame: GivenFrame
    numbers: NDArray[np.float32]  # (rows, width)
    is_text: bool


class _EndedError(Exception):
    """The client has ended the session before it began."""


class _Faults:
    """Tells faults of messages, those of one code once a while; all are counted."""

    def __init__(self, channel: Channel) -> None:
        self.counts: Counter[str] = Counter()
        self._channel = channel
        self._told: dict[str, float] = {}

    def tell(self, code: str, message: str, number: int) -> None:
        """Count a fault, which is about the frame with a number, -1 if it is about none."""
        self.counts[code] += 1
        now = time.monotonic()
        if now - self._told.get(code, -math.inf) < LOOP.fault_s:
            return
        self._told[code] = now
        about = number if number >= 0 else None
        said = {"type": "fault", "code": code, "message": message, "number": about}
        self._channel.send(Message.of(said))


def _read_object(data: bytes) -> dict[str, Any]:
    try:
        said = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise MessageError(f"the message is no JSON: {str(error)[:100]}") from error
    if not isinstance(said, dict):
        raise MessageError("a message is an object of JSON")
    return said


def _rounded(told: tuple[float, float]) -> dict[str, float | None]:
    """Return a running error as JSON values."""
    return {
        name: round(value, 4) if math.isfinite(value) else None
        for name, value in zip(("p50", "p95"), told, strict=True)
    }
