"""A solver process: started apart, listened to, and stopped for certain."""

from __future__ import annotations

import json
import math
import os
import select
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import structlog

from service.bounds import fit_progress, refuse_constant, shorten
from service.settings import Settings
from solver.cache import VARIABLE as CACHE_VARIABLE
from solver.cache import cache_path
from solver.kinds.live_channel import Channel
from worker import kernels
from worker.caches import TenantCache
from worker.orphans import FOLDER_VARIABLE, note_session
from worker.sandbox import allowed_environment

GRACE = 1.0
# Seconds of processor time beyond those that an attempt may last: its supervisor comes first
CPU_MARGIN = 60.0
LONGEST_LINE = 4000
MOST_LINES = 500
MOST_LINES_KEPT = 20_000

# Processes that ended before they got a job, in a row, after which no more are started
MOST_FAILURES = 3
LAST_WORDS = 64 * 1024  # bytes, as many as a pipe holds

# The cache folder in an attempt's
CACHE = "cache"
# Libraries of linear algebra start their threads when they are loaded
BLAS_THREADS = ("MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")

log = structlog.get_logger()


class _Interpreter:
    """A Python process of the solver's, in a session of its own, and the pipes to listen to it.

    Started by exec, not by a bare fork: the numeric libraries' thread pools do not survive a fork.
    One for a ``live`` session has a channel as well, and gives way to nobody.
    """

    def __init__(
        self,
        words: Sequence[str],
        settings: Settings,
        environment: dict[str, str],
        *,
        live: bool = False,
        **how: Any,
    ) -> None:
        reading, writing = os.pipe()
        self.channel: Channel | None = None
        theirs: Channel | None = None
        if live:
            self.channel, theirs = Channel.pair()
        given = [writing] if theirs is None else [writing, theirs.fileno()]
        words = [*words, str(0 if live else settings.solver_niceness), *map(str, given)]
        try:
            self.process: subprocess.Popen[bytes] = subprocess.Popen(
                [sys.executable, "-P", "-m", "worker.solve", *words],
                env=allowed_environment(settings.solver_variables)
                | _thread_counts(settings.solver_threads)
                | environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                pass_fds=given,
                start_new_session=True,
                **how,
            )
        except BaseException:
            os.close(reading)
            if self.channel is not None:
                self.channel.close()
            raise
        finally:
            os.close(writing)
            if theirs is not None:
                theirs.close()
        self.steps = os.fdopen(reading, "rb")

    def is_ready(self) -> bool:
        """Return whether a process that waits has said so, by its first line."""
        listening = select.poll()
        listening.register(self.steps, select.POLLIN)
        return any(event & select.POLLIN for _, event in listening.poll(0))


class Standby:
    """Solver processes that have loaded their code and wait, each for one job and no more.

    They are started before the job is known, with nothing of any tenant, and confine themselves
    when they are told its folder, as every solver process does before it reads a file of it. One
    that is still loading, or has ended meanwhile, is missed by nobody: the job then starts a
    process of its own. After `MOST_FAILURES` that ended in a row no more are started.
    """

    def __init__(self, settings: Settings, count: int, *, live: bool = False) -> None:
        self._settings = settings
        self._count = count if is_standby_possible(settings) else 0
        self._live = live
        self._lock = threading.Lock()
        self._waiting: deque[_Interpreter] = deque()
        self._failures = 0

    def fill(self) -> None:
        """Start what is missing.

        The system ends them with the thread that calls this: it lives as long as the worker.
        """
        with self._lock:
            self._drop_ended()
            while len(self._waiting) < self._count and self._failures < MOST_FAILURES:
                words = ["--standby", str(os.getpid())]
                one_thread = dict.fromkeys(BLAS_THREADS, "1")  # others would not be confined
                try:
                    started = _Interpreter(
                        words, self._settings, one_thread, live=self._live, stdin=subprocess.PIPE
                    )
                except OSError as error:
                    log.warning("standby.failed", error=str(error))
                    return
                self._waiting.append(started)

    def take(self, folder: Path) -> _Interpreter | None:
        """Give the job in ``folder`` to a process that is ready for it, if there is one."""
        with self._lock:
            self._drop_ended()
            for each in [each for each in self._waiting if each.is_ready()]:
                if _tell(each, folder):
                    self._waiting.remove(each)
                    self._failures = 0
                    return each
                self._drop(each)
        return None

    def _drop_ended(self) -> None:
        for each in [each for each in self._waiting if each.process.poll() is not None]:
            self._drop(each)

    def _drop(self, failed: _Interpreter) -> None:
        self._waiting.remove(failed)
        self._failures += 1
        _end(failed)
        if self._failures == MOST_FAILURES:
            log.error("standby.given_up", failures=self._failures)

    def stop(self) -> None:
        """End what waits."""
        with self._lock:
            while self._waiting:
                _end(self._waiting.popleft())


def is_standby_possible(settings: Settings) -> bool:
    """Return whether processes may wait for jobs: they must be able to confine themselves later."""
    return settings.solver_confined and sys.platform == "linux"


class SolverProcess:
    """``python -m worker.solve <folder>`` in a session, and so a process group, of its own.

    The system ends it when it has used the processor for longer than all its threads could in
    ``seconds``, should nobody be left to end it earlier. ``standby`` may have one that waits. That
    of a ``live`` session has a ``channel``.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        tenant: str,
        seconds: float,
        standby: Standby | None = None,
        *,
        live: bool = False,
    ) -> None:
        # these go with the folder, also when the solver is killed
        temporary, cache, compiled = (folder / name for name in ("tmp", CACHE, "kernels"))
        temporary.mkdir()
        kept = TenantCache(tenant, settings)
        kept.link_into(cache)
        kernels.link_kernels(compiled)
        reads = [cache_path().absolute(), kept.folder, kernels.installed_place()]
        environment = {
            FOLDER_VARIABLE: str(folder),
            "TMPDIR": str(temporary),
            "HOME": str(temporary),
            CACHE_VARIABLE: str(cache),
            kernels.KERNELS_VARIABLE: str(compiled),
        }
        (folder / "process.json").write_text(
            json.dumps(
                {
                    "parent": os.getpid(),
                    "memory_bytes": settings.solver_memory_mb * 1024**2,
                    "cpu_seconds": math.ceil(seconds * settings.solver_threads + CPU_MARGIN),
                    "jobs": settings.jobs,
                    "confined": settings.solver_confined,
                    "reads": [str(place) for place in reads if place],
                    "environment": environment,
                }
            )
        )
        waiting = standby.take(folder) if standby else None
        self.was_ready = waiting is not None
        if waiting is None:
            words = [str(folder)]
            how = {"cwd": folder, "stdin": subprocess.DEVNULL}
            waiting = _Interpreter(words, settings, environment, live=live, **how)
        self._process = waiting.process
        self.channel = waiting.channel
        assert self._process.stdout is not None
        self._steps = _Lines(waiting.steps, newest=True)
        self._log = _Lines(self._process.stdout)
        self._room = MOST_LINES_KEPT
        try:
            note_session(folder, self.pid)
        except BaseException:
            self.finish()
            raise

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def wait(self, seconds: float) -> int | None:
        """Wait for the end; returns the exit code (negative: the signal), None if still running."""
        try:
            return self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def steps(self) -> list[dict[str, Any]]:
        """Return the reports of progress since the last call, the newest of each phase."""
        newest: dict[str, dict[str, Any]] = {}
        for line in self._steps.take()[0]:
            if (step := _step(line)) is not None:
                newest.pop(step["phase"], None)
                newest[step["phase"]] = step
        return list(newest.values())

    def lines(self) -> list[str]:
        """Return the lines printed since the last call; a flood is cut to its beginning.

        The first `MOST_LINES_KEPT` lines of an attempt are kept.
        """
        (lines, left_out), room = self._log.take(), self._room
        if left_out:
            lines.append(f"... {left_out} lines left out")
        self._room = max(room - len(lines), 0)
        if room and not self._room:
            lines[room:] = ["... this is all that is kept of the log"]
        else:
            lines = lines[:room]
        return [shorten(line.expandtabs(4), LONGEST_LINE) for line in lines]

    def finish(self) -> None:
        """End what is left of the process group, then read the last lines."""
        _signal_group(self.pid, signal.SIGKILL)
        self._process.wait()
        self._steps.join()
        self._log.join()

    def stop(self) -> None:
        """Stop the whole process group: TERM, one second, KILL."""
        _signal_group(self.pid, signal.SIGTERM)
        self.wait(GRACE)
        self.finish()


class _Lines:
    """Reads lines in a thread, so that a full pipe never blocks the solver.

    Between two calls of `take` it holds `MOST_LINES`, the ``newest`` or else the first, and of a
    line the beginning: whatever the solver says, it takes little memory here.
    """

    def __init__(self, stream: IO[bytes], newest: bool = False) -> None:
        self._newest = newest
        self._lines: deque[str] = deque(maxlen=MOST_LINES)
        self._left_out = 0
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._read, args=(stream,), daemon=True)
        self._thread.start()

    def take(self) -> tuple[list[str], int]:
        """Return the lines since the last call, and how many there were beside them."""
        with self._lock:
            taken = list(self._lines), self._left_out
            self._lines.clear()
            self._left_out = 0
        return taken

    def join(self) -> None:
        self._thread.join(timeout=GRACE)

    def _read(self, stream: IO[bytes]) -> None:
        begins = True
        with stream:
            while piece := stream.readline(LONGEST_LINE):
                if begins:
                    self._keep(piece.decode(errors="replace").rstrip("\r\n"))
                begins = piece.endswith(b"\n")

    def _keep(self, line: str) -> None:
        with self._lock:
            is_full = len(self._lines) == MOST_LINES
            self._left_out += is_full
            if self._newest or not is_full:
                self._lines.append(line)


def _tell(waiting: _Interpreter, folder: Path) -> bool:
    """Tell a process that is ready where its job is; False: it has ended."""
    stdin = waiting.process.stdin
    assert stdin is not None
    waiting.steps.readline()  # that it is ready
    try:
        with stdin:
            stdin.write(os.fsencode(folder) + b"\n")
    except OSError:
        return False
    return True


def _end(started: _Interpreter) -> None:
    """End a process that has no job; of one that ended by itself, log what it said last."""
    code = started.process.poll()
    said = started.process.stdout
    _signal_group(started.process.pid, signal.SIGKILL)
    started.process.wait()
    if code is not None and said is not None:
        os.set_blocking(said.fileno(), False)
        words = (said.read(LAST_WORDS) or b"").decode(errors="replace").strip()
        log.warning("standby.ended", code=code, said=words[-LONGEST_LINE:])
    for pipe in (started.steps, started.process.stdin, started.process.stdout, started.channel):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()


def _step(line: str) -> dict[str, Any] | None:
    """Return a report of progress; None: that is none."""
    try:
        found = json.loads(line, parse_constant=refuse_constant)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict):
        return None
    phase = found.get("phase")
    fraction = found.get("fraction")
    if not (isinstance(phase, str) and isinstance(fraction, int | float)):
        return None
    return fit_progress(found)


def _signal_group(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except (ProcessLookupError, PermissionError):
        return  # gone already (macOS says "permission" about a group of zombies)


def _thread_counts(threads: int) -> dict[str, str]:
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", *BLAS_THREADS)
    # and those of kernels sleep while they wait for the next one
    return dict.fromkeys(names, str(threads)) | {"OMP_WAIT_POLICY": "passive"}
