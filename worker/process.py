"""A solver process: started apart, listened to, and stopped for certain."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import structlog

from service.bounds import PROGRESS, fit, refuse_constant, shorten
from service.queue.states import HELD
from service.settings import Settings
from service.store.database import Store
from service.store.models import Job
from worker import kernels
from worker.sandbox import allowed_environment

GRACE = 1.0
# Seconds of processor time beyond those that an attempt may last: its supervisor comes first
CPU_MARGIN = 60.0
LONGEST_LINE = 4000
MOST_LINES = 500
MOST_LINES_KEPT = 20_000

# In the environment of a solver process, and so of every process that it starts
FOLDER_VARIABLE = "MYOFACE_ATTEMPT"
# Names the folder of what the solver keeps from job to job (`solver.storage.cache_directory`)
CACHE_VARIABLE = "MYOFACE_CACHE"
# Below the work folder, a folder for each tenant
CACHES = "caches"
CACHED_SECONDS = 30 * 24 * 3600.0
# The name of an attempt's folder, `<job>.<attempt>`; nothing else is ever removed
ATTEMPT = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\.\d+")

log = structlog.get_logger()


class SolverProcess:
    """``python -m worker.solve <folder>`` in a session, and so a process group, of its own.

    Started by exec, not by a bare fork: the numeric libraries' thread pools do not survive a fork.
    The system ends it when it has used the processor for longer than all its threads could in
    ``seconds``, should nobody be left to end it earlier.
    """

    def __init__(self, folder: Path, settings: Settings, tenant: str, seconds: float) -> None:
        temporary = folder / "tmp"  # goes with the folder, also when the solver is killed
        temporary.mkdir()
        compiled = folder / "kernels"
        kernels.lend(compiled)
        assets = Path(os.environ.get(CACHE_VARIABLE) or Path.home() / ".cache" / "myoface")
        reading, writing = os.pipe()
        (folder / "process.json").write_text(
            json.dumps(
                {
                    "progress_fd": writing,
                    "parent": os.getpid(),
                    "memory_bytes": settings.solver_memory_mb * 1024**2,
                    "cpu_seconds": math.ceil(seconds * settings.solver_threads + CPU_MARGIN),
                    "jobs": settings.jobs,
                    "confined": settings.solver_confined,
                    "assets": str(assets),
                }
            )
        )
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "worker.solve", str(folder)],
            cwd=folder,
            env=allowed_environment(settings.solver_variables)
            | _thread_counts(settings.solver_threads)
            | {
                FOLDER_VARIABLE: str(folder),
                "TMPDIR": str(temporary),
                "HOME": str(temporary),
                CACHE_VARIABLE: str(_cache_of(tenant, settings.work, assets)),
                kernels.VARIABLE: str(compiled),
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=[writing],
            start_new_session=True,
        )
        os.close(writing)
        assert self._process.stdout is not None
        self._steps = _Lines(os.fdopen(reading, "rb"), newest=True)
        self._log = _Lines(self._process.stdout)
        self._room = MOST_LINES_KEPT

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
        """Return the lines printed since the last call; of a flood only the beginning.

        Of all that an attempt says, the first `MOST_LINES_KEPT` lines are kept.
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


def _step(line: str) -> dict[str, Any] | None:
    """Return a report of progress; None: that is none."""
    try:
        found = json.loads(line, parse_constant=refuse_constant)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict):
        return None
    phase, fraction = found.get("phase"), found.get("fraction")
    if not (isinstance(phase, str) and isinstance(fraction, int | float)):
        return None
    return fit({"phase": phase, "fraction": fraction, **found}, PROGRESS)  # the first stay


def _signal_group(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except (ProcessLookupError, PermissionError):
        return  # gone already (macOS says "permission" about a group of zombies)


def _thread_counts(threads: int) -> dict[str, str]:
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    # and those of kernels sleep while they wait for the next one
    return dict.fromkeys(names, str(threads)) | {"OMP_WAIT_POLICY": "passive"}


def _cache_of(tenant: str, work: Path, assets: Path) -> Path:
    """Return the folder in which a tenant's jobs keep what they made of his templates.

    What another's job wrote is never read. The installation's assets are there as links.
    """
    folder = work / CACHES / tenant
    folder.mkdir(parents=True, exist_ok=True)
    for asset in filter(Path.is_file, assets.glob("*")):
        with suppress(FileExistsError):
            (folder / asset.name).symlink_to(asset)
    return folder


def remove_orphans(store: Store, work: Path) -> None:
    """Remove the folders of attempts that nobody is at any more, and end their processes.

    The solver itself dies with its supervisor, but not what it had started (the mesher).
    """
    if not work.is_dir():
        return
    _remove_unused(work / CACHES)
    for folder in work.iterdir():
        if ATTEMPT.fullmatch(folder.name) and not _is_held(store, folder.name):
            end_processes(folder)
            remove_tree(folder)
            log.info("attempt.removed", folder=folder.name)


def remove_tree(folder: Path) -> None:
    """Remove a folder that a solver could write: however deep it is, and whatever its modes are."""
    with suppress(RecursionError):
        shutil.rmtree(folder, ignore_errors=True)
    if folder.exists():
        for command in (["chmod", "-R", "u+rwX"], ["rm", "-rf"]):
            subprocess.run([*command, "--", str(folder)], check=False, capture_output=True)


def _remove_unused(caches: Path) -> None:
    """Remove what tenants' caches have had for long; whoever needs it makes it anew."""
    for file in caches.glob("*/*"):
        with suppress(FileNotFoundError):
            if file.lstat().st_mtime > time.time() - CACHED_SECONDS:
                continue
            if file.is_dir() and not file.is_symlink():
                remove_tree(file)
            else:
                file.unlink()


def end_processes(folder: Path) -> None:
    """Kill the processes of an attempt (Linux; elsewhere they end by themselves)."""
    mark = f"{FOLDER_VARIABLE}={folder}".encode()
    for environment in Path("/proc").glob("[0-9]*/environ"):
        try:
            if mark in environment.read_bytes().split(b"\0"):
                os.kill(int(environment.parent.name), signal.SIGKILL)
        except OSError:
            continue  # gone meanwhile, or another user's


def _is_held(store: Store, name: str) -> bool:
    job_id, _, attempt = name.rpartition(".")
    with store.read() as session:
        job = session.get(Job, job_id)
        return job is not None and job.state in HELD and str(job.attempt) == attempt
