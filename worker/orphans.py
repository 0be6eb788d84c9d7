"""Clean up after attempts whose worker died: folders, and processes that a solver had started."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import structlog

from service.queue.states import FINAL, HELD
from service.queue.wakeups import LIVE
from service.store.database import Store
from service.store.models import Job

# The name of an attempt's folder, `<job>.<attempt>`; nothing else is ever removed
ATTEMPT = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\.\d+")
# Of the file beside the folder, where no solver writes, with the session of its processes
SESSION = ".session"
# In the environment of a solver process and all that it starts: their attempt's folder
FOLDER_VARIABLE = "MYOFACE_ATTEMPT"

log = structlog.get_logger()


def remove_orphans(store: Store, work: Path) -> None:
    """Remove the folders of attempts that nobody is at any more, and end their processes.

    The solver itself dies with its supervisor, but not what it had started (the mesher).
    """
    if not work.is_dir():
        return
    # a worker that died as it removed one may have left the file beside it
    for folder in {path.with_name(path.name.removesuffix(SESSION)) for path in work.iterdir()}:
        if ATTEMPT.fullmatch(folder.name) and not _is_held(store, folder.name):
            end_processes(folder)
            if _has_takes(store, folder.name):
                continue
            remove_attempt(folder)
            log.info("attempt.removed", folder=folder.name)


def note_session(folder: Path, leader: int) -> None:
    """Note the session of an attempt's processes, which its solver began.

    None that is confined leaves it: the filter of system calls refuses a session of one's own.
    """
    noted = {"leader": leader, "started": _start_time(leader), "system": _boot_and_namespace()}
    _note_path(folder).write_text(json.dumps(noted))


def end_processes(folder: Path) -> None:
    """Kill the processes of an attempt (Linux; elsewhere they end by themselves).

    Processes that are not confined may have left the attempt's session; they have its mark.
    """
    for process in {*_of_session(folder), *_with_mark(folder)}:
        with suppress(OSError):  # gone meanwhile
            os.kill(process, signal.SIGKILL)


def remove_attempt(folder: Path) -> None:
    """Remove an attempt's folder and what was noted of its processes."""
    remove_tree(folder)
    _note_path(folder).unlink(missing_ok=True)


def _of_session(folder: Path) -> Iterator[int]:
    """Yield the processes of the session that was noted of an attempt."""
    try:
        noted = json.loads(_note_path(folder).read_text())
    except (FileNotFoundError, ValueError):  # none was started, or the disk was full
        return
    if noted["system"] != _boot_and_namespace():
        return
    leader = noted["leader"]
    if _start_time(leader) not in (noted["started"], None):
        return  # the session is over and another process has its number
    for process in _processes():
        if (fields := _stat(process)) and int(fields[3]) == leader:
            yield process


def _with_mark(folder: Path) -> Iterator[int]:
    """Yield the processes that have an attempt's mark in their environment."""
    mark = f"{FOLDER_VARIABLE}={folder}".encode()
    for process in _processes():
        with suppress(OSError):  # gone, or another user's
            if mark in Path(f"/proc/{process}/environ").read_bytes().split(b"\0"):
                yield process


def remove_tree(folder: Path) -> None:
    """Remove what a solver could write: however deep it is, and whatever its modes are."""
    if folder.is_symlink() or not folder.is_dir():
        folder.unlink(missing_ok=True)
        return
    with suppress(RecursionError):
        shutil.rmtree(folder, ignore_errors=True)
    if folder.exists():
        for command in (["chmod", "-R", "u+rwX"], ["rm", "-rf"]):
            subprocess.run([*command, "--", str(folder)], check=False, capture_output=True)


def _is_held(store: Store, name: str) -> bool:
    job_id, _, attempt = name.rpartition(".")
    with store.read() as session:
        job = session.get(Job, job_id)
        return job is not None and job.state in HELD and str(job.attempt) == attempt


def _has_takes(store: Store, name: str) -> bool:
    """Return whether the next attempt at a live session may take over what one was recording."""
    job_id, _, attempt = name.rpartition(".")
    with store.read() as session:
        job = session.get(Job, job_id)
        if job is None or job.queue != LIVE or job.state in FINAL:
            return False
        return int(attempt) in (job.attempt, job.attempt - 1)


def _note_path(folder: Path) -> Path:
    return folder.with_name(folder.name + SESSION)


def _processes() -> Iterator[int]:
    return (int(folder.name) for folder in Path("/proc").glob("[0-9]*"))


def _start_time(process: int) -> str | None:
    """Return when a process started, in ticks of the machine; None: there is no such process."""
    fields = _stat(process)
    return fields[19] if fields else None


def _stat(process: int) -> list[str]:
    """Return the fields of ``/proc/<pid>/stat`` after the program's name, which can hold anything.

    They are state, parent, group, session and so on (proc(5)).
    """
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return []


def _boot_and_namespace() -> str:
    """Return boot id and PID namespace: pids noted under another are meaningless."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""
