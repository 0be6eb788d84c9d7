"""Latency and endurance of live sessions through a running service, over its WebSocket.

A part of :mod:`benchmarks.live`. The service is one of its own, with a copy of a data folder that
has a rig, as ``myoface demo`` leaves one; a station on the same machine sends frames at their rate.
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import anyio
import numpy as np
import psutil

from benchmarks.documents import Figures, Table
from myoface.client import AsyncClient, Client
from myoface.client.aio_live import AsyncLiveFace
from myoface.client.live_frames import LiveFrame
from myoface.stack import SPARE, Stack
from service.settings import Settings
from solver.kinds.live_session import Source
from solver.scans.live_link import ARKIT_NAMES, FaceTake, read_live_link
from solver.surface import Floats

PARTS = ("session", "sources", "sessions", "resume", "soak")
SESSIONS = 4
WARM_FRAMES = 60  # a process's first frames load what later ones have
RESUME_WITHIN = 30.0  # s that a session may take to come back
SOAK_S = 1800.0

Frames = Sequence[Mapping[str, float]] | Sequence[np.ndarray]


class Recording(Protocol):
    """A recording on a rig, as each source has it."""

    files: dict[str, Path]  # that the sources' frames need, by their roles

    def frames(self, source: Source) -> Sequence[np.ndarray]:
        """Return the numbers of each frame, none where the rig has no such source."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of these parts."""
    parser.add_argument("--data", type=Path, help="a service's folder with a rig; it is copied")
    parser.add_argument("--soak", type=float, default=SOAK_S, help="seconds of the soak")


def run(options: argparse.Namespace, recording: Callable[[Path], Recording]) -> Figures:
    """Return the figures of the parts that are asked for, of the newest rig in a folder.

    ``recording`` has the frames of a rig's file, beside which it may leave others.
    """
    rate = options.rate
    seconds = options.seconds or 60.0
    found: Figures = {}
    with TemporaryDirectory() as folder, service(options.data, Path(folder) / "data") as stack:
        with Client(stack.url, stack.key) as client:
            rig = client.rigs()[0].id
            if "sources" in options.parts:
                beside = Path(folder) / "rig"
                beside.mkdir()
                client.download_rig(rig, beside)
                played = recording(beside / "rig.npz")
        frames = recorded(options.recording, rate, options.first, seconds)
        # the first session makes the rig's live skin
        found["first"] = anyio.run(one_session, stack, rig, frames, rate, 5.0)
        if "session" in options.parts:
            found["session"] = anyio.run(one_session, stack, rig, frames, rate, seconds)
        if "sources" in options.parts:
            for source in options.sources:
                numbers = played.frames(source)
                if not numbers:
                    continue
                captures = _marker_set(stack, rig, played) if source == "markers" else []
                found[source] = anyio.run(
                    one_session, stack, rig, numbers, rate, seconds, source, captures
                )
        if "sessions" in options.parts:
            found["sessions"] = anyio.run(several_sessions, stack, rig, frames, SESSIONS, 30.0)
        if "resume" in options.parts:
            found["resume_s"] = {
                kill.__name__.removeprefix("kill_"): anyio.run(
                    resume, stack, rig, frames, rate, kill
                )
                for kill in (kill_solver, kill_worker, kill_broker)
            }
        if "soak" in options.parts:
            found["soak"] = anyio.run(soak, stack, rig, frames, rate, options.soak)
    return found


def recorded(path: Path, rate: float, first: float, seconds: float) -> list[dict[str, float]]:
    """Return ARKit's weights of a recording's frames at a rate, from its second ``first`` on."""
    take = read_live_link(path)
    times = np.arange(first, min(first + seconds, float(take.times[-1])), 1.0 / rate)
    rows = between(take, times, take.weights).tolist()
    return [dict(zip(ARKIT_NAMES, row, strict=True)) for row in rows]


def between(take: FaceTake, times: Floats, rows: Floats) -> Floats:
    """Return a take's ``rows`` (f, k) at other ``times`` (g,), those between its own: (g, k)."""
    return np.column_stack([np.interp(times, take.times, column) for column in rows.T])


def table(figures: Figures) -> Table:
    """Return the figures as a table of the document."""
    rows = [[part, name, value] for part, told in figures.items() for name, value in told.items()]
    return Table(["part", "figure", "value"], rows)


@dataclass
class Station:
    """What a station saw of one session: of frames by number, when each was sent and came back."""

    sent: dict[int, float] = field(default_factory=dict)
    came: dict[int, float] = field(default_factory=dict)
    solve_ms: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    def latencies_ms(self, first: int = WARM_FRAMES) -> np.ndarray:
        """Return the time from a frame's sending to its face, of frames after the first ones."""
        numbers = [number for number in sorted(self.came) if number > first]
        return np.array([1e3 * (self.came[number] - self.sent[number]) for number in numbers])

    def figures(self) -> dict[str, float]:
        """Return latencies in ms, and the share of frames without a face in percent."""
        found = self.latencies_ms()
        asked = sum(number > WARM_FRAMES for number in self.sent)
        told = dict(zip(("p50", "p95", "p99"), np.percentile(found, [50, 95, 99]), strict=True))
        rounded = {f"latency_{name}_ms": round(float(value), 2) for name, value in told.items()}
        solved = np.percentile(self.solve_ms[WARM_FRAMES:], [50, 99])
        return {
            **rounded,
            "latency_greatest_ms": round(float(found.max()), 2),
            "solve_p50_ms": round(float(solved[0]), 2),
            "solve_p99_ms": round(float(solved[1]), 2),
            "frames": asked,
            "dropped_percent": round(100.0 * (1.0 - len(found) / asked), 3),
        }

    def take(self, frame: LiveFrame) -> None:
        """Note a face."""
        self.came[frame.number] = time.monotonic()
        self.solve_ms.append(frame.solve_ms)
        if not math.isnan(frame.error_p50_mm):
            self.errors.append(frame.error_p50_mm)


@contextmanager
def service(data: Path, folder: Path) -> Iterator[Stack]:
    """Start a service on a copy of a data folder."""
    shutil.copytree(data, folder, ignore=shutil.ignore_patterns("broker", "logs"))
    with Stack(Settings(data_dir=folder, port=0, webhook_workers=0)) as stack:
        yield stack


async def play(
    face: AsyncLiveFace, frames: Frames, rate: float, seconds: float, station: Station
) -> None:
    """Send frames at their rate, from the first again after the last, and take what comes back."""
    count = round(rate * seconds)
    start = time.monotonic()

    async def send() -> None:
        for row in range(count):
            await anyio.sleep(max(start + row / rate - time.monotonic(), 0.0))
            # noted before: the answer may be here before the call returns; frames count from 1
            station.sent[row + 1] = time.monotonic()
            await face.send(frames[row % len(frames)])

    async with anyio.create_task_group() as tasks:
        tasks.start_soon(send)
        while time.monotonic() < start + seconds + 1.0:
            frame = await face.receive(0.5)
            if frame is not None:
                station.take(frame)


def _marker_set(stack: Stack, rig: str, played: Recording) -> list[str]:
    """Upload a recording's marker set; return its id."""
    with Client(stack.url, stack.key) as client:
        subject = client.rig(rig).subject_id
        path = played.files["marker_set"]
        return [client.ensure_capture(subject, path, name="live_markers", role="markers").id]


async def one_session(
    stack: Stack,
    rig: str,
    frames: Frames,
    rate: float,
    seconds: float,
    source: Source = "weights",
    captures: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the figures of one session; ``captures`` may have the id of a marker set."""
    station = Station()
    async with AsyncClient(stack.url, stack.key) as client:
        began = time.monotonic()
        about: dict[str, Any] = {"source": source, "captures": captures, "options": {"rate": rate}}
        async with client.live(rig, **about) as face:
            ready = time.monotonic() - began
            await play(face, frames, rate, seconds, station)
    told = round(fmean(station.errors), 4) if station.errors else None
    return {"ready_s": round(ready, 2), **station.figures(), "told_p50_mm": told}


async def several_sessions(
    stack: Stack, rig: str, frames: Frames, count: int, seconds: float
) -> dict[str, Any]:
    """Return the worst figures of ``count`` sessions at 30 frames a second each."""
    stations = [Station() for _ in range(count)]

    async def hold(station: Station) -> None:
        async with (
            AsyncClient(stack.url, stack.key) as client,
            client.live(rig, options={"rate": 30.0}) as face,
        ):
            await play(face, frames, 30.0, seconds, station)

    async with anyio.create_task_group() as tasks:
        for station in stations:
            tasks.start_soon(hold, station)
    every = [station.figures() for station in stations]
    return {"sessions": count} | {
        name: max(each[name] for each in every)
        for name in ("latency_p50_ms", "latency_p95_ms", "latency_p99_ms", "dropped_percent")
    }


async def resume(
    stack: Stack, rig: str, frames: Frames, rate: float, kill: Callable[[Stack], None]
) -> float:
    """Return the seconds from a blow to the next face of a session."""
    station = Station()
    blow = 0.0
    async with (
        AsyncClient(stack.url, stack.key) as client,
        client.live(rig, options={"rate": rate}) as face,
        anyio.create_task_group() as tasks,
    ):
        tasks.start_soon(play, face, frames, rate, 5.0 + RESUME_WITHIN, station)
        await anyio.sleep(5.0)
        blow = time.monotonic()
        kill(stack)
        await anyio.sleep(0.2)  # what was on its way
        while time.monotonic() < blow + RESUME_WITHIN:
            later = [moment for moment in station.came.values() if moment > blow + 0.2]
            if later:
                tasks.cancel_scope.cancel()
                return round(min(later) - blow, 2)
            await anyio.sleep(0.05)
    return math.inf


def kill_solver(stack: Stack) -> None:
    """Kill the solver process of the session that is held."""
    for name in ("live", SPARE):
        for child in psutil.Process(stack.pid(name)).children(recursive=True):
            if "--standby" not in child.cmdline() or child.cpu_times().user > 1.0:
                child.send_signal(signal.SIGKILL)


def kill_worker(stack: Stack) -> None:
    """Kill the worker that has a session, and with it its solver."""
    pids = [stack.pid(name) for name in ("live", SPARE)]
    busy = max(pids, key=lambda pid: _processor_s(psutil.Process(pid)))
    os.kill(busy, signal.SIGKILL)


def kill_broker(stack: Stack) -> None:
    """Kill the broker."""
    os.kill(stack.pid("broker"), signal.SIGKILL)


def _processor_s(process: psutil.Process) -> float:
    every = process.children(recursive=True)
    return float(sum(each.cpu_times().user for each in every))


async def soak(
    stack: Stack, rig: str, frames: Frames, rate: float, seconds: float
) -> dict[str, Any]:
    """Return how memory and latency of a long session grew, from its second minute to its last."""
    station = Station()
    memory: list[float] = []
    async with (
        AsyncClient(stack.url, stack.key) as client,
        client.live(rig, options={"rate": rate}) as face,
        anyio.create_task_group() as tasks,
    ):
        tasks.start_soon(play, face, frames, rate, seconds, station)
        for _ in range(round(seconds / 10.0)):
            await anyio.sleep(10.0)
            memory.append(_memory_mb(stack))
    found = station.latencies_ms()
    minute = round(60 * rate)
    first, last = (float(np.median(part)) for part in (found[:minute], found[-minute:]))
    after = memory[6:12] or memory[:1]
    return {
        "minutes": round(seconds / 60.0, 1),
        "memory_grows_mb": round(fmean(memory[-6:]) - fmean(after), 1),
        "latency_last_over_first": round(last / first, 3),
        **station.figures(),
    }


def _memory_mb(stack: Stack) -> float:
    """Return the memory that all processes of a service have of their own."""
    pids = [stack.pid(name) for name in ("api", "live", SPARE, "broker")]
    tree = [psutil.Process(pid) for pid in pids]
    tree += [child for each in tree for child in each.children(recursive=True)]
    total = 0
    for process in tree:
        try:
            total += process.memory_full_info().uss
        except psutil.NoSuchProcess:
            continue
    return float(total) / 1e6
