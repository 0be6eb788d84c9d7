"""Supervise one job from claim to commit, while its solver works in a process of its own."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from typing import Any, NamedTuple, TypeVar

import structlog
from sqlalchemy.exc import DataError, IntegrityError, ProgrammingError, SQLAlchemyError
from sqlalchemy.orm import Session

from service import tracing
from service.queue import table
from service.queue.claims import Abilities, claim_next
from service.queue.states import State
from service.queue.table import Claim
from service.queue.wakeups import LIVE
from service.settings import Settings
from service.store.database import Store
from service.store.models import Artifact, Tenant
from service.store.usage import free_bytes
from solver.kinds import KINDS
from worker.attempt import AttemptFolder
from worker.caches import TenantCache
from worker.errors import (
    NO_ROOM,
    STORAGE_FULL,
    CanceledError,
    HopelessError,
    LeaseLostError,
    OutputSizeError,
    ShutdownError,
    crash_error,
    exit_error,
    is_full,
    storage_error,
    timeout_error,
)
from worker.live import Bridge
from worker.process import CACHE, SolverProcess, Standby

Done = TypeVar("Done")

# Errors of the database that no waiting mends: it answers, and does not take what it is given
REFUSED_BY_DATABASE = (DataError, IntegrityError, ProgrammingError)

# Beats of a session in the time of a silence that is too long
BEATS_OF_SILENCE = 5

# Bytes that a solver may write besides what it leaves, and the beats from one count to the next
SCRATCH = 8 << 30
COUNT_EVERY = 10

log = structlog.get_logger()


class _News(NamedTuple):
    """Reports and files of the solver, until the database has them."""

    steps: list[dict[str, Any]]
    lines: list[str]
    chunks: list[dict[str, Any]]
    kept: dict[str, Artifact]


class Supervisor:
    """Runs one job at a time as a worker that can do ``can``; ``stopping`` ends the work early.

    ``standby`` may have solver processes that wait for a job.
    """

    def __init__(
        self,
        store: Store,
        settings: Settings,
        can: Abilities,
        stopping: threading.Event,
        standby: Standby | None = None,
    ) -> None:
        self._store = store
        self._settings = settings
        self._can = can
        self._stopping = stopping
        self._standby = standby
        self._renewed = 0.0
        self._unwritten = _News([], [], [], {})
        self._bridge: Bridge | None = None
        self._goes_on = False

    def run_next(self, queue: str) -> bool:
        """Claim the best job of a queue, do it and commit; False: there is none to be had."""
        with self._store.write() as session:
            settings = self._settings
            claim = claim_next(session, queue, self._can, settings.lease, settings.sweeper_term)
        if claim is None:
            return False
        self._renewed = time.monotonic()
        self._unwritten = _News([], [], [], {})
        self._goes_on = False
        ids: dict[str, Any] = {"job_id": claim.job_id, "attempt": claim.attempt}
        with (
            structlog.contextvars.bound_contextvars(**ids),
            tracing.trace_work(f"attempt {claim.kind}", claim.traceparent, queue=queue, **ids),
        ):
            log.info("job.claimed", kind=claim.kind)
            folder = AttemptFolder(self._settings.work, claim)
            try:
                self._run(claim, folder)
            except Exception as error:  # whatever it is, other jobs must go on
                log.exception("worker.crashed")
                with suppress(SQLAlchemyError):  # then the lease will run out
                    self._lose(claim, crash_error(error))
            finally:
                self._clear(claim, folder)
                if self._standby and not self._stopping.is_set():
                    self._standby.fill()
        return True

    def _run(self, claim: Claim, folder: AttemptFolder) -> None:
        """Do a job, and commit how it ended."""
        try:
            self._attempt(claim, folder)
        except HopelessError as error:
            self._fail(claim, error.error)
        except OSError as error:
            if is_full(error):
                self._postpone(claim)
            else:
                self._lose(claim, storage_error(error))

    def _clear(self, claim: Claim, folder: AttemptFolder) -> None:
        """Keep what later jobs of the tenant need, and remove the rest.

        Of a session that goes on the next attempt takes over what it was recording; the sweeper
        removes it then.
        """
        try:
            TenantCache(claim.tenant_id, self._settings).keep_new(folder.path / CACHE)
            if not (self._goes_on and KINDS[claim.kind].queue == LIVE):
                folder.remove()
        except OSError as error:  # the sweeper tries again
            log.warning("attempt.not_removed", error=str(error))

    def _attempt(self, claim: Claim, folder: AttemptFolder) -> None:
        with self._leased(claim):
            folder.stage(self._store)
        limit = self._limit(claim, folder)
        live = KINDS[claim.kind].queue == LIVE
        process = SolverProcess(
            folder.path, self._settings, claim.tenant_id, limit, self._standby, live=live
        )
        log.info("solver.started", pid=process.pid, was_ready=process.was_ready)
        try:
            if process.channel is not None:
                if self._standby:
                    self._standby.fill()  # sessions are long: not only when they have ended
                self._bridge = Bridge(
                    process.channel, self._settings.broker, claim.job_id, claim.attempt
                )
                self._bridge.start()
            code = self._watch(claim, process, folder, time.monotonic() + limit)
            if code is None:
                process.stop()
            process.finish()
            self._beat(claim, process, folder)
            while any(self._unwritten):  # the database is away: frames and lines wait for it
                time.sleep(self._settings.beat)
                self._beat(claim, process, folder)
            self._stop_bridge()  # its last words come before the end is known
        except CanceledError:
            process.stop()
            self._confirm_cancel(claim)
            _report_end("canceled")
        except ShutdownError:
            process.stop()
            self._goes_on = True
            self._commit(lambda session: table.release(session, claim.job_id, claim.attempt))
            _report_end("released")
        except LeaseLostError:
            process.stop()
            _report_end("lease_lost", failed=True)
        else:
            self._commit_outcome(claim, folder, code, limit)
        finally:
            process.finish()
            self._stop_bridge()

    def _stop_bridge(self) -> None:
        if self._bridge is not None:
            self._bridge.stop()
            self._bridge = None

    def _limit(self, claim: Claim, folder: AttemptFolder) -> float:
        """Return the seconds that an attempt may last."""
        most = self._settings.max_seconds(
            KINDS[claim.kind].given(claim.options), folder.input_bytes
        )
        return min(most, claim.deadline_s or most)

    def _watch(
        self, claim: Claim, process: SolverProcess, folder: AttemptFolder, end: float
    ) -> int | None:
        """Wait for the solver's exit code, with a beat now and then; None: not before ``end``."""
        for number in count(1):
            if (code := process.wait(self._beat_seconds(claim))) is not None:
                break
            if self._stopping.is_set():
                raise ShutdownError
            if time.monotonic() > end:
                return None
            self._beat(claim, process, folder)
            if number % COUNT_EVERY == 0:
                _check_written(claim, folder)
        return code

    def _beat_seconds(self, claim: Claim) -> float:
        """Return the seconds between two beats."""
        beat = self._settings.beat
        if KINDS[claim.kind].queue == LIVE:
            return min(beat, self._settings.live_silence / BEATS_OF_SILENCE)
        return beat

    @contextmanager
    def _leased(self, claim: Claim) -> Iterator[None]:
        """Renew the lease meanwhile: files may be moved for longer than it lasts."""
        done = threading.Event()

        def renew() -> None:
            while not done.wait(self._beat_seconds(claim)):
                with suppress(SQLAlchemyError):
                    with self._store.write() as session:
                        job = (claim.job_id, claim.attempt)
                        state = table.beat(session, *job, self._settings.lease)
                    if state is not None:
                        self._renewed = time.monotonic()

        thread = threading.Thread(target=renew, name="lease", daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()

    def _beat(self, claim: Claim, process: SolverProcess, folder: AttemptFolder) -> None:
        """Renew the lease, pass on what the solver said and left, and see whether to stop.

        A database that does not answer is no reason to stop before the lease has run out; what
        was said meanwhile is written down when it does.
        """
        news = self._unwritten
        news.steps.extend(process.steps())
        news.lines.extend(process.lines())
        if self._bridge is not None:
            folder.keep(self._bridge.left())
        try:
            self._check_size(claim, folder)
            with self._leased(claim):
                news.chunks.extend(folder.new_frames(self._store.files))
                news.kept.update(folder.new_kept(self._store.files))
            with self._store.write() as session:
                state = table.beat(
                    session,
                    claim.job_id,
                    claim.attempt,
                    self._settings.lease,
                    steps=news.steps,
                    lines=news.lines,
                    chunks=news.chunks,
                    kept=news.kept.values(),
                )
        except REFUSED_BY_DATABASE:
            raise
        except SQLAlchemyError as error:
            log.warning("database.unreachable", error=str(error))
            if time.monotonic() - self._renewed > self._settings.lease:
                raise LeaseLostError from error
            return
        self._renewed = time.monotonic()
        self._unwritten = _News([], [], [], {})
        if state is None:
            raise LeaseLostError
        if state is State.CANCELING:
            raise CanceledError

    def _check_size(self, claim: Claim, folder: AttemptFolder, *, at_end: bool = False) -> int:
        """Check, before anything is stored, that there is room; return the bytes to be stored.

        Raises
        ------
        OutputSizeError
            If it is more than its kind may leave, or its tenant may store.
        InvalidOutputError
            If they are more files than any job leaves.
        """
        most = KINDS[claim.kind].max_bytes
        found = folder.measure()
        if found > most:
            message = f"{claim.kind} left {found} bytes, more than the {most} that it may leave"
            raise OutputSizeError("solver.output", message, most, found)
        if new := folder.unstored_bytes(at_end=at_end):
            with self._store.read() as session:
                _check_quota(session, claim, new)
        return new

    def _commit_outcome(
        self, claim: Claim, folder: AttemptFolder, code: int | None, limit: float
    ) -> None:
        """Commit what the solver left: a result, an error, or nothing; without ``code``, its end.

        A job that took longer than ``limit`` would take as long once more: it has failed.
        """
        if code is None or code == -signal.SIGXCPU:
            self._fail(claim, timeout_error(claim.kind, limit, folder.frames, folder.kept))
            return
        result = folder.result()
        error = folder.error()
        if code == 0 and result is not None:
            new = self._check_size(claim, folder, at_end=True)
            self._succeed(claim, folder, result, new)
        elif error is not None:
            self._fail(claim, error)
        elif code == NO_ROOM:
            self._postpone(claim)
        else:
            self._lose(claim, exit_error(code))

    def _succeed(
        self, claim: Claim, folder: AttemptFolder, result: dict[str, Any], new: int
    ) -> None:
        with self._leased(claim):
            artifacts = folder.store(self._store.files, result["formats"])
        rig = folder.rig(result)

        def change(session: Session) -> bool:
            if new:  # another job of the tenant may have ended meanwhile
                session.get_one(Tenant, claim.tenant_id, with_for_update={"key_share": True})
                _check_quota(session, claim, new)
            job = (claim.job_id, claim.attempt)
            summary = result["summary"]
            return table.succeed(session, *job, artifacts, summary=summary, rig=rig)

        done = self._commit(change)
        _report_end("succeeded" if done else "fenced")
        if not done:
            self._confirm_cancel(claim)

    def _confirm_cancel(self, claim: Claim) -> None:
        self._commit(lambda session: table.confirm_cancel(session, claim.job_id, claim.attempt))

    def _fail(self, claim: Claim, error: dict[str, Any]) -> None:
        job = (claim.job_id, claim.attempt)
        done = self._commit(lambda session: table.fail(session, *job, error))
        _report_end("failed" if done else "fenced", failed=done, code=error["code"])
        if not done:
            self._confirm_cancel(claim)

    def _lose(self, claim: Claim, error: dict[str, Any]) -> None:
        self._goes_on = True
        self._commit(lambda session: table.lose(session, claim.job_id, claim.attempt, error))
        _report_end("attempt_lost", failed=True, error=error)

    def _postpone(self, claim: Claim) -> None:
        self._commit(
            lambda session: table.postpone(session, claim.job_id, claim.attempt, STORAGE_FULL)
        )
        _report_end("postponed", failed=True, error=STORAGE_FULL)

    def _commit(self, change: Callable[[Session], Done]) -> Done:
        """Write down how an attempt ended; tries again until the lease has run out.

        The work is done: it would be a pity to lose it because the database is away for a moment.

        Raises
        ------
        SQLAlchemyError
            If the database did not answer in time: somebody else does the job again.
        """
        while True:
            try:
                with self._store.write() as session:
                    return change(session)
            except REFUSED_BY_DATABASE:
                raise
            except SQLAlchemyError as error:
                if time.monotonic() - self._renewed > self._settings.lease:
                    raise
                log.warning("database.unreachable", error=str(error))
                time.sleep(self._settings.beat)


def _check_quota(session: Session, claim: Claim, new: int) -> None:
    """Raise OutputSizeError if the outputs do not fit into the tenant's quota."""
    free = free_bytes(session, claim.tenant_id)
    if free is not None and new > free:
        message = f"the job leaves {new} bytes, and the quota has room for {free}"
        raise OutputSizeError("quota.bytes", message, free, new)


def _check_written(claim: Claim, folder: AttemptFolder) -> None:
    """Raise OutputSizeError if a solver fills the disk with what it does not leave."""
    most = KINDS[claim.kind].max_bytes + SCRATCH
    found = folder.written_bytes
    if found > most:
        message = f"{claim.kind} wrote {found} bytes, more than the {most} that it may write"
        raise OutputSizeError("solver.output", message, most, found)


def _report_end(outcome: str, failed: bool = False, **more: Any) -> None:
    """Log and trace how an attempt ended."""
    (log.warning if failed else log.info)(f"job.{outcome}", **more)
    tracing.note(failed, outcome=outcome)
