"""From claim to commit: one job, watched while its solver works in a process of its own."""

from __future__ import annotations

import errno
import signal
import threading
import time
from typing import Any, NamedTuple

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service.settings import Settings
from service.store import jobs
from service.store.jobs import Claim
from service.store.store import Store
from service.store.transitions import State
from worker.attempt import AttemptFolder
from worker.process import SolverProcess

log = structlog.get_logger()


class LeaseLostError(Exception):
    """The job is no longer this worker's."""


class CanceledError(Exception):
    """Somebody asked for the job to stop."""


class ShutdownError(Exception):
    """The worker is to stop."""


class _News(NamedTuple):
    """What the solver said and left, until the database knows it."""

    steps: list[dict[str, Any]]
    lines: list[str]
    chunks: list[dict[str, Any]]


class Supervisor:
    """Runs one job at a time for the worker ``name``; ``stopping`` ends the work early."""

    def __init__(
        self, store: Store, settings: Settings, name: str, stopping: threading.Event
    ) -> None:
        self._store = store
        self._settings = settings
        self._name = name
        self._stopping = stopping
        self._renewed = 0.0
        self._unwritten = _News([], [], [])

    def run(self, job_id: str) -> None:
        """Claim the job, do it and commit. Not to be had (done, taken, canceled): do nothing."""
        with self._store.write() as session:
            claim = jobs.claim(session, job_id, self._name, self._settings.lease)
        if claim is None:
            log.info("job.not_mine", job_id=job_id)
            return
        self._renewed = time.monotonic()
        self._unwritten = _News([], [], [])
        with structlog.contextvars.bound_contextvars(job_id=job_id, attempt=claim.attempt):
            log.info("job.claimed", kind=claim.kind)
            folder = AttemptFolder(self._settings.work, claim)
            try:
                self._attempt(claim, folder)
            except OSError as error:
                self._lose(claim, _storage_error(error))
            finally:
                folder.remove()

    def _attempt(self, claim: Claim, folder: AttemptFolder) -> None:
        folder.stage(self._store.files)
        process = SolverProcess(folder.path, self._settings)
        log.info("solver.started", pid=process.pid)
        try:
            code = self._watch(claim, process, folder)
            process.finish()
            self._beat(claim, process, folder)
        except CanceledError:
            process.stop()
            with self._store.write() as session:
                jobs.confirm_cancel(session, claim.job_id, claim.attempt)
            log.info("job.canceled")
        except ShutdownError:
            process.stop()
            with self._store.write() as session:
                jobs.release(session, claim.job_id, claim.attempt)
            log.info("job.released")
        except LeaseLostError:
            process.stop()
            log.warning("job.lease_lost")
        else:
            self._settle(claim, folder, code)
        finally:
            process.finish()

    def _watch(self, claim: Claim, process: SolverProcess, folder: AttemptFolder) -> int:
        """Wait for the solver's exit code, with a beat now and then."""
        while (code := process.wait(self._settings.beat)) is None:
            if self._stopping.is_set():
                raise ShutdownError
            self._beat(claim, process, folder)
        return code

    def _beat(self, claim: Claim, process: SolverProcess, folder: AttemptFolder) -> None:
        """Renew the lease, pass on what the solver said and left, and see whether to stop.

        A database that does not answer is no reason to stop before the lease has run out; what
        was said meanwhile is written down when it does.
        """
        news = self._unwritten
        news.steps.extend(process.steps())
        news.lines.extend(process.lines())
        news.chunks.extend(folder.new_frames(self._store.files))
        try:
            with self._store.write() as session:
                state = jobs.beat(
                    session,
                    claim.job_id,
                    claim.attempt,
                    self._settings.lease,
                    steps=news.steps,
                    lines=news.lines,
                    chunks=news.chunks,
                )
        except SQLAlchemyError as error:
            log.warning("database.unreachable", error=str(error))
            if time.monotonic() - self._renewed > self._settings.lease:
                raise LeaseLostError from error
            return
        self._renewed = time.monotonic()
        self._unwritten = _News([], [], [])
        if state is None:
            raise LeaseLostError
        if state is State.CANCELING:
            raise CanceledError

    def _settle(self, claim: Claim, folder: AttemptFolder, code: int) -> None:
        """Commit what the solver left: a result, an error, or nothing."""
        result, error = folder.result(), folder.error()
        if code == 0 and result is not None:
            artifacts = folder.store(self._store.files)
            with self._store.write() as session:
                done = jobs.succeed(
                    session,
                    claim.job_id,
                    claim.attempt,
                    artifacts,
                    summary=result["summary"],
                    rig=folder.rig(result),
                )
            log.info("job.succeeded" if done else "job.fenced")
        elif error is not None:
            with self._store.write() as session:
                done = jobs.fail(session, claim.job_id, claim.attempt, error)
            log.info("job.failed" if done else "job.fenced", code=error["code"])
        else:
            self._lose(claim, _exit_error(code))
            return
        if not done:
            with self._store.write() as session:
                jobs.confirm_cancel(session, claim.job_id, claim.attempt)

    def _lose(self, claim: Claim, error: dict[str, Any]) -> None:
        with self._store.write() as session:
            jobs.lose(session, claim.job_id, claim.attempt, error)
        log.warning("job.attempt_lost", error=error)


def _exit_error(code: int) -> dict[str, Any]:
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


def _storage_error(error: OSError) -> dict[str, Any]:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT)
    return {
        "code": "storage.full" if full else "storage.failed",
        "message": "there is no room left for files" if full else error.strerror or str(error),
    }
