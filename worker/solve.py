"""``python -m worker.solve <attempt folder> <niceness> <pipe> [<channel>]``: the solver process.

Reads ``job.json``, calls the kind's module of `solver.jobs` and writes ``result.json`` or
``error.json``; progress goes as JSON lines to a pipe, the log to standard error. It knows no
database and no queue, so whatever happens to it costs an attempt at most. The messages of a live
session come and go by the channel.

``python -m worker.solve --standby <parent> <niceness> <pipe> ...`` loads code that most of a job's
start goes into, says a line on the pipe when it is ready, and is told the folder of its one job on
standard input. The code that it loads knows no job, has no kernels (they are looked for in the
attempt's folder) and starts no threads (they would not be confined).
"""

from __future__ import annotations

import importlib
import json
import math
import os
import re
import resource
import signal
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import structlog

from service.bounds import ERROR, fit, fit_progress, fit_result
from service.process import configure_logs, die_with_parent
from solver.jobs import run_job
from solver.kinds import FILES, KINDS, format_number
from solver.kinds.live_channel import Channel
from solver.landmarker import VARIABLE as LANDMARKER
from worker import sandbox
from worker.errors import NO_ROOM, is_full

if TYPE_CHECKING:
    from solver.progress import ProgressCallback, Step

RESULT = "result.json"
FAILURE = "error.json"
STANDBY = "--standby"
# What a check loads and needs no job for; none of these has kernels
AHEAD = (
    *("igl", "numba", "PIL.Image", "trimesh", "solver.registration.search"),
    *("scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.sparse.csgraph"),
)

log = structlog.get_logger()


def stand_by(parent: int, progress_fd: int) -> Path | None:
    """Load code, say so, and return the folder of the job that comes; None: there is no more."""
    die_with_parent(parent, signal.SIGKILL)
    for name in AHEAD:
        importlib.import_module(name)
    if sandbox.count_threads() > 1:
        sys.exit("what was loaded has started threads, which cannot be confined any more")
    os.write(progress_fd, b"ready\n")
    told = sys.stdin.buffer.readline().rstrip(b"\n")
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), sys.stdin.fileno())
    if not told:
        return None
    folder = Path(os.fsdecode(told))
    os.chdir(folder)
    tempfile.tempdir = None  # somebody may have asked for it
    os.environ.update(json.loads((folder / "process.json").read_text())["environment"])
    numba_config = importlib.import_module("numba.core.config")
    numba_config.reload_config()  # of the folder of its kernels
    return folder


def main(folder: Path, progress_fd: int, channel: Channel | None = None) -> int:
    """Do the job in ``folder``; returns the exit code."""
    process = json.loads((folder / "process.json").read_text())
    die_with_parent(process["parent"], signal.SIGKILL)
    configure_logs(json=False)
    resource.setrlimit(resource.RLIMIT_DATA, (process["memory_bytes"],) * 2)
    seconds = process["cpu_seconds"]
    # the soft limit's signal says why; at the hard one Linux kills without a word
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 5))
    if process["confined"]:
        _confine(folder, process["jobs"], process["reads"])
    try:
        try:
            with os.fdopen(progress_fd, "w", buffering=1) as pipe:
                verdict = RESULT
                result = solve(folder, to_pipe(pipe.write), process["jobs"], channel)
        except Exception as error:
            if is_full(error):
                raise
            verdict = FAILURE
            result = _describe_error(error, process["memory_bytes"])
        _write(folder, verdict, result)
    except Exception as error:
        if not is_full(error):
            raise
        log.exception("solver.no_room")
        return NO_ROOM
    return 0 if verdict == RESULT else 1


def _confine(folder: Path, jobs: str, reads: list[str]) -> None:
    """Shut this process off from all but the code, what it may read, and its folder."""
    importlib.import_module(jobs)
    packages = ("solver", "service", "worker", jobs.partition(".")[0])
    landmarker = os.environ.get(LANDMARKER)
    absent = sandbox.missing_layers()  # before: the filter refuses the calls that ask the kernel
    sandbox.confine(packages, map(Path, filter(None, [*reads, landmarker])), writes=[folder])
    for missing in absent:
        log.warning("solver.not_confined", missing=missing)


def _step_back(niceness: int) -> None:
    """Take the time that the API, the supervisors and others leave.

    Where Linux weighs sessions against each other, a process's own niceness counts only within its
    session, and this one is alone in its.
    """
    os.nice(niceness)
    with suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(niceness))


def _describe_error(error: Exception, memory_bytes: int) -> dict[str, Any]:
    """Log an error with its traceback; returns what the job tells of it."""
    from solver.errors import InputError, SolveError

    if isinstance(error, (InputError, SolveError)):
        log.exception("solver.refused")
        return error.as_dict()
    if isinstance(error, MemoryError):
        log.exception("solver.out_of_memory")
        message = f"the solver needs more memory than its {memory_bytes // 1024**2} MB"
        return {"code": "solver.memory", "message": message}
    log.exception("solver.crashed")
    message = f"the solver failed: {type(error).__name__}: {error}"
    return {"code": "solver.crash", "message": message}


def solve(
    folder: Path,
    progress: ProgressCallback,
    jobs: str = "solver.jobs",
    channel: Channel | None = None,
) -> dict[str, Any]:
    """Do the job; returns ``{summary, expressions, formats}``, what it tells of its results."""
    job = json.loads((folder / "job.json").read_text())
    files: dict[str, Path] = {}
    captures: dict[str, Path] = {}
    facts: dict[str, Path] = {}
    masks: dict[str, Path] = {}
    role = "unknown"
    for item in job["inputs"]:
        role = item.get("capture_role", role)
        path = Path(item["path"])
        if item["role"] in ("capture", "photo", "asset", "wrinkles"):
            captures[item["name"]] = path
        elif item["role"] == "facts":
            facts[item["name"]] = path
        elif item["role"] == "mask":
            masks[item["name"]] = path
        else:
            files[item["role"]] = path
    run_job(
        job["kind"],
        folder / "out",
        options=job["options"],
        captures=captures,
        facts=facts,
        masks=masks,
        role=role,
        resume=job["resume"],
        progress=progress,
        channel=channel,
        jobs=jobs,
        **files,
    )
    kind = KINDS[job["kind"]].given(job["options"])
    out = folder / "out"
    formats = {name: format_number(out / name) for name in FILES if (out / name).is_file()}
    return {**_describe(out / kind.report, is_rig=kind.leaves == "rig"), "formats": formats}


def _describe(file: Path, *, is_rig: bool) -> dict[str, Any]:
    """Return what a job tells of its results; a rig's expressions are told apart.

    They are those that its files show: of its muscles, else of its default system.
    """
    summary = json.loads(file.read_text())
    if not isinstance(summary, dict):
        raise TypeError(f"{file.name} is no JSON object")
    if not is_rig:
        return {"expressions": [], "summary": summary}
    shown = (
        name for name, fits in summary.get("systems", {}).items() if summary.get("system") in fits
    )
    expressions = list(summary.pop("expressions", ())) or list(shown)
    return {"expressions": expressions, "summary": summary}


def to_pipe(write: Callable[[str], Any]) -> ProgressCallback:
    """Return a progress that writes JSON lines; a supervisor that is gone does not matter."""

    def report(step: Step, /) -> None:
        values = _plain(fit_progress(step.as_dict()))
        log.info(**{"event": values["phase"], **values})
        try:
            write(json.dumps(values) + "\n")
        except BrokenPipeError:
            signal.raise_signal(signal.SIGTERM)

    return report


def _write(folder: Path, name: str, content: dict[str, Any]) -> None:
    """Write a verdict, whole or not at all; the attempt's folders do not show in it.

    This is the gate of all that a job tells: what it quotes of a stranger's file is short, and a
    terminal may show it.
    """
    inputs = re.compile(re.escape(f"{folder}/inputs/") + r"\d+/")

    def without_folders(text: str) -> str:
        return inputs.sub("", text).replace(f"{folder}/out/", "")

    told = _plain(content, without_folders)
    told = fit_result(**told) if name == RESULT else fit(told, ERROR)
    partial = folder / f"{name}.partial"
    partial.write_text(json.dumps(told))
    partial.replace(folder / name)


def _plain(value: Any, words: Callable[[str], str] = str) -> Any:
    """Return ``value`` as JSON values, its texts by ``words``; what is not finite becomes null."""
    if isinstance(value, dict):
        return {str(key): _plain(item, words) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item, words) for item in value]
    if hasattr(value, "tolist"):  # numpy's numbers and arrays
        return _plain(value.tolist(), words)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, (int, float, type(None))):
        return value
    return words(str(value))


def start(words: Sequence[str]) -> int:
    """Do the job of a command line, now or when it comes; returns the exit code."""
    place, rest = (words[1], words[2:]) if words[0] == STANDBY else (words[0], words[1:])
    niceness, progress_fd, *channels = map(int, rest)
    _step_back(niceness)
    channel = Channel.inherited(channels[0]) if channels else None  # before sockets are refused
    folder = stand_by(int(place), progress_fd) if words[0] == STANDBY else Path(place)
    return 0 if folder is None else main(folder, progress_fd, channel)


if __name__ == "__main__":
    sys.exit(start(sys.argv[1:]))
