"""Errors that end an attempt early, and what the job says of them."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Mapping, Sequence
from typing import Any

# The exit code of a solver process that found the disk full
NO_ROOM = os.EX_TEMPFAIL
STORAGE_FULL = {"code": "storage.full", "message": "there is no room left for files"}


class LeaseLostError(Exception):
    """The job is no longer this worker's."""


class CanceledError(Exception):
    """Somebody asked for the job to stop."""


class ShutdownError(Exception):
    """The worker is to stop."""


class HopelessError(Exception):
    """No attempt at the job can succeed; ``error`` is what it tells of that."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(error["message"])
        self.error = error


class InvalidOutputError(HopelessError):
    """The solver's output is nothing that the solver would write by itself."""

    def __init__(self, message: str) -> None:
        super().__init__({"code": "solver.verdict", "message": message})


class OutputSizeError(HopelessError):
    """A job leaves more bytes than its kind may leave, or its tenant may store."""

    def __init__(self, code: str, message: str, expected: int, found: int) -> None:
        error = {"code": code, "message": message, "expected": expected, "found": found}
        super().__init__(error)


class LostInputError(HopelessError):
    """A file that a job reads is lost or damaged."""

    def __init__(self, item: Mapping[str, Any], fault: str) -> None:
        what = item["filename"]
        if item["name"] != what:
            what += f" of {item['name']}"
        super().__init__(
            {
                "code": "files.lost",
                "message": f"the job's {item['role']}, {what}, is {fault} in the file store",
                "file": item["filename"],
                "capture": item["name"],
            }
        )


def is_full(error: BaseException | None) -> bool:
    """Return whether an error, or what it was raised from, is that of a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


def exit_error(code: int) -> dict[str, Any]:
    """Return the error of a solver process that ended with ``code`` and left no verdict."""
    if code < 0:
        name = signal.Signals(-code).name
        return {
            "code": "solver.killed",
            "message": f"the solver process was ended by {name}",
            "signal": name,
        }
    return {
        "code": "solver.killed",
        "message": f"the solver process exited with {code} and said nothing",
        "exit_code": code,
    }


def timeout_error(kind: str, seconds: float, frames: int, files: Sequence[str]) -> dict[str, Any]:
    """Return the error of a job that was ended for its time, and what it leaves."""
    left = [f"{frames} frames"] if frames else []
    left += [f"{len(files)} files to go on with"] if files else []
    kept = f": {' and '.join(left)} are kept" if left else ": nothing is kept"
    return {
        "code": "job.timeout",
        "message": f"{kind} was ended after {seconds:g} s, the most it may take{kept}",
        "seconds": seconds,
        "frames": frames,
        "kept": list(files),
    }


def crash_error(error: Exception) -> dict[str, Any]:
    """Return the error of an attempt that ended by a fault of the worker's own.

    Its words stay in the log: a database's quote statements and addresses.
    """
    return {"code": "worker.crash", "message": f"the worker failed: {type(error).__name__}"}


def storage_error(error: OSError) -> dict[str, Any]:
    """Return the error of files that could not be read or written."""
    return {"code": "storage.failed", "message": error.strerror or str(error)}
