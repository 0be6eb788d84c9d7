"""The command that holds a live session at a station."""

from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import AbstractAsyncContextManager, AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import Annotated, Any, Literal

import anyio

from myoface.cli.app import NewFolder, Url
from myoface.cli.commands import Argument, Option, UsageError
from myoface.cli.console import Console, err, out
from myoface.cli.lookup import find_rig, refuse_missing
from myoface.client import DEFAULT_URL, AsyncClient, Client
from myoface.client.aio_live import AsyncLiveFace
from myoface.errors import ApiError, StackError
from myoface.live.datagrams import PacketError, Port
from myoface.live.lines import read_line
from myoface.live.live_link import read_packet
from myoface.live.osc_faces import OscReader
from myoface.live.replay import Replay, play
from myoface.live.sinks import LineSink, OscSink
from myoface.live.station import Given, Sink, Station, Tally, alone
from myoface.resources import FromJob

Source = Literal["weights", "markers", "points", "landmarks"]
LAST_PORT = 65535
SHOW_S = 0.5  # between two looks at how a session goes
USUAL_RATE = 60.0  # frames a second, where neither a file nor a person says how many
MOST_RATE = 240.0  # that a session takes
MARKER_SET = "markers.json"
TAKE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")  # names of takes


def read_host(word: str) -> tuple[str, int]:
    """Return the host and the port of HOST:PORT."""
    host, _, port = word.rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) <= LAST_PORT):
        raise ValueError(f"{word!r} is no HOST:PORT, such as 127.0.0.1:9000")
    return host.strip("[]"), int(port)


def read_take(word: str) -> str:
    """Return the name of a take, which a file is called by."""
    if not TAKE.fullmatch(word):
        raise ValueError(f"{word!r} is no name of a take: letters, digits, '.', '_' and '-'")
    return word


Rig = Annotated[
    str,
    Argument(
        help="rig of the service: its id, the start of it, or the name; or a file rig.npz, whose "
        "session is held in this process (Linux, from a checkout)"
    ),
]


def live(
    rig: Rig,
    live_link: Annotated[
        int | None,
        Option(metavar="PORT", min=1, max=LAST_PORT, help="follow the app Live Link Face: 11111"),
    ] = None,
    osc: Annotated[
        int | None, Option(metavar="PORT", min=1, max=LAST_PORT, help="follow OSC, by UDP")
    ] = None,
    stdin: Annotated[
        bool, Option("--stdin", help="follow lines of JSON on standard input")
    ] = False,
    replay: Annotated[
        Path | None,
        Option(exists=True, dir_okay=False, metavar="TAKE", help="follow a file at its own rate"),
    ] = None,
    sender: Annotated[
        str | None,
        Option("--from", metavar="ADDRESS", help="of who may send; else the first that does"),
    ] = None,
    to_osc: Annotated[
        tuple[str, int] | None,
        Option(metavar="HOST:PORT", parser=read_host, help="send faces there as OSC"),
    ] = None,
    stdout: Annotated[
        bool, Option("--stdout", help="write faces as lines of JSON to standard output")
    ] = False,
    record: Annotated[
        str | None, Option(metavar="NAME", parser=read_take, help="record a take from the start")
    ] = None,
    source: Annotated[
        Source | None, Option(help="what the frames of --osc and --stdin are; default: weights")
    ] = None,
    rate: Annotated[
        float | None,
        Option(min=1, max=MOST_RATE, help="frames a second; default: the file's, or 60"),
    ] = None,
    smooth_hz: Annotated[
        float | None, Option(min=0.5, max=120, help="cutoff of a filter of what goes out")
    ] = None,
    marker_set: Annotated[
        str | None,
        Option(help="of markers: a file; of a service the id of its capture, or of its check"),
    ] = None,
    template: Annotated[
        Path | None, Option(exists=True, help="the rig's template, where a file is followed")
    ] = None,
    output: NewFolder = Path("live"),
    url: Url = DEFAULT_URL,
) -> None:
    """Hold a live session: the face of a rig follows what comes, until it ends or Ctrl-C."""
    with ExitStack() as opened:
        if replay is not None:
            opened.enter_context(_faults())
        feed = _feed(live_link, osc, stdin, replay, sender, source, rate)
        options = {"rate": feed.rate, **({"smooth_hz": smooth_hz} if smooth_hz else {})}
        sinks: list[Sink] = [LineSink(sys.stdout)] if stdout else []
        if to_osc is not None:
            sent = OscSink(*to_osc)
            opened.callback(sent.close)
            sinks.append(sent)
        told = err if stdout else out
        station = Station(sinks, record=record, waits=feed.waits)
        shown = _Shown(station, feed, told)
        opened.callback(told.show_live, "")
        if Path(rig).exists():
            files = _files(Path(rig), template, marker_set)
            given = {**options, "source": feed.source}
            opened.enter_context(_faults())
            anyio.run(_run_here, files, given, output, station, shown)
        else:
            refuse_missing(rig)
            with Client(url) as client:
                found = find_rig(client, rig)
                captures = [] if marker_set is None else [_marker_set(client, marker_set)]
            anyio.run(_run_there, url, found, captures, options, station, shown)
        told.show_live("")
        shown.summarise()


@dataclass(frozen=True)
class _Feed:
    """What a session follows: the kind of frames, how many a second, and where they come from."""

    source: str
    rate: float
    frames: AsyncIterator[Given]
    waits: bool = False
    port: Port | None = None
    refused: list[str] | None = None  # lines that were no frames


def _feed(
    live_link: int | None,
    osc: int | None,
    stdin: bool,
    replay: Path | None,
    sender: str | None,
    source: str | None,
    rate: float | None,
) -> _Feed:
    """Return the one source that was named."""
    named = [live_link is not None, osc is not None, stdin, replay is not None]
    if sum(named) != 1:
        raise UsageError("give one of --live-link, --osc, --stdin and --replay")
    if sender is not None and not (live_link or osc):
        raise UsageError("--from is for --live-link and --osc: nothing else comes by the network")
    usual = rate or USUAL_RATE
    if replay is not None:
        found = Replay.open(replay, usual)
        return _Feed(source or found.source, rate or min(found.rate, MOST_RATE), play(found.frames))
    if stdin:
        refused: list[str] = []
        return _Feed(source or "weights", usual, _lines(refused), waits=True, refused=refused)
    parse = read_packet if live_link is not None else OscReader().read
    if live_link is not None and source not in (None, "weights"):
        raise UsageError("Live Link Face sends weights")
    try:
        port = Port(live_link or osc or 0, parse, sender)
    except ValueError as error:
        raise UsageError(f"--from {sender}: it is no address such as 192.168.0.7") from error
    return _Feed(source or "weights", usual, port.frames(), port=port)


async def _lines(refused: list[str]) -> AsyncIterator[Given]:
    """Yield what the lines on standard input say."""
    number = 0
    async for line in anyio.wrap_file(sys.stdin):
        number += 1
        try:
            given = read_line(line) if line.strip() else None
        except PacketError as error:
            refused.append(f"line {number}: {error}")
            continue
        if given is not None:
            yield given


def _files(rig: Path, template: Path | None, marker_set: str | None) -> dict[str, Path]:
    """Return the files of a session that is held here, by their roles."""
    try:
        from solver.rig import find_files
    except ModuleNotFoundError as error:
        raise StackError(
            "a file is followed from a checkout of Myoface alone; name a rig of a service"
        ) from error
    files = dict(find_files(rig))
    if template is not None:
        files["template"] = template
    if marker_set is not None:
        files["marker_set"] = Path(marker_set)
    return files


def _faults() -> AbstractContextManager[None]:
    """Tell faults of files that are read here."""
    try:
        from myoface.cli import checkout
    except ModuleNotFoundError as error:
        raise StackError(
            "files are read by a checkout of Myoface alone; name a rig of a service"
        ) from error
    checkout.configure_logs()
    return checkout.told_faults()


def _marker_set(client: Client, given: str) -> str | FromJob:
    """Return the marker set of a service's session: what a check left, or a capture."""
    try:
        job = client.job(given)
    except ApiError as error:
        if error.status != 404:
            raise
        return given
    return FromJob(job=job.id, artifact=MARKER_SET)


async def _run_here(
    files: Mapping[str, Path],
    options: Mapping[str, Any],
    folder: Path,
    station: Station,
    shown: _Shown,
) -> None:
    from myoface.live.local import hold_session

    held = hold_session(files, options, folder, shown.said)
    await _run(held, station, shown)


async def _run_there(
    url: str,
    rig: str,
    captures: list[str | FromJob],
    options: dict[str, Any],
    station: Station,
    shown: _Shown,
) -> None:
    async with AsyncClient(url) as client:
        source = shown.feed.source
        shown.page = f"{url.rstrip('/')}/rigs/{rig}"
        held = client.live(
            rig, source=source, captures=captures, options=options, listen=shown.said
        )
        await _run(held, station, shown)


async def _run(
    held: AbstractAsyncContextManager[AsyncLiveFace], station: Station, shown: _Shown
) -> None:
    """Run a station on a session that is held, until its source ends or somebody wants it to."""
    with alone():
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(_stop_at_signal, station)
            tasks.start_soon(shown.show)
            async with held as face:
                shown.begin(face.id)
                await station.run(face, shown.feed.frames)
            tasks.cancel_scope.cancel()


async def _stop_at_signal(station: Station) -> None:
    """Stop the station when asked to: its take is stored first. Asked again, the program ends."""
    with (
        suppress(NotImplementedError),  # Windows ends the program at once
        anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals,
    ):
        async for _ in signals:
            if station.is_stopping:
                raise KeyboardInterrupt
            station.stop()


class _Shown:
    """Tells a person how a session goes."""

    def __init__(self, station: Station, feed: _Feed, console: Console) -> None:
        self.feed = feed
        self.page: str | None = None
        self._station = station
        self._console = console
        self._phase = ""
        self._before = (time.monotonic(), 0, 0)

    def said(self, message: dict[str, Any]) -> None:
        """Take what the session says, and pass it to the station."""
        if message.get("type") == "preparing":
            phase = str(message.get("phase"))
            fraction = float(message.get("fraction") or 0.0)
            if phase != self._phase and not self._console.is_terminal:
                self._console.print(f"live: {phase}")
            self._phase = phase
            self._console.show_bar("live", fraction, phase)
        self._station.said(message)

    def begin(self, session: str) -> None:
        """Say where the session can be seen."""
        self._console.show_live("")
        if self.page:
            self._console.print(f"live: session {session}, {self.page}?live={session}")
        else:
            self._console.print("live: ready")

    async def show(self) -> None:
        """Show how the session goes, now and then."""
        while True:
            await anyio.sleep(SHOW_S)
            tally = self._station.tally
            if tally.sent:
                self._console.show_live(self._now(tally))

    def _now(self, tally: Tally) -> str:
        now = time.monotonic()
        then, sent, followed = self._before
        self._before = (now, tally.sent, tally.followed)
        passed = now - then
        rates = f"{(tally.sent - sent) / passed:.0f} in, {(tally.followed - followed) / passed:.0f}"
        return f"live: {rates} out a second, {_error(tally)}, {tally.dropped} dropped"

    def summarise(self) -> None:
        """Say what became of the session."""
        tally = self._station.tally
        dropped = tally.dropped + tally.dropped_here
        say = self._console.print
        say(f"{tally.sent} frames sent, {tally.followed} followed, {dropped} dropped")
        if tally.followed:
            shares = [f"{tally.latency_ms(share):.1f}" for share in (0.5, 0.95, 0.99)]
            say(f"a face comes after {shares[0]} ms, 95 % within {shares[1]}, 99 % {shares[2]}")
            say(_error(tally))
        if (port := self.feed.port) is not None and (port.counts.garbage or port.counts.foreign):
            counts = port.counts
            say(f"{counts.garbage} packets were garbage, {counts.foreign} came from elsewhere")
        faults = [*(self.feed.refused or ()), *filter(None, [tally.first_fault])]
        if faults:
            say(
                f"{len(self.feed.refused or ()) + tally.refused + tally.faults} faults, {faults[0]}"
            )
        for take in tally.takes:
            say(f"{take['name']}: {take['file']}, {take['frames']} frames, {take['seconds']:.1f} s")
        if tally.ended not in (None, "asked"):
            say(f"the session has ended: {tally.ended}")


def _error(tally: Tally) -> str:
    p50, p95 = tally.error_mm
    if isnan(p50):
        return "how far off is not known yet"
    return f"off a full solve {p50:.2f} mm, 95 % within {p95:.2f}"
