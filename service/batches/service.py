"""Batch operations: create, cancel, and queue what a running one needs next."""

from __future__ import annotations

import os
import socket
from http import HTTPStatus
from typing import Any

import structlog
from sqlalchemy.orm import Session

from service.background import Background
from service.batches import repository
from service.batches.repository import (
    CHECK,
    FIT,
    MODEL,
    REGISTER,
    BatchProgress,
    ScanStatus,
    failure,
)
from service.batches.schemas import NewBatch
from service.captures import repository as captures
from service.captures import service as scans
from service.captures.repository import registered_form
from service.errors import Problem
from service.jobs import service as work
from service.jobs.options import check_options
from service.jobs.schemas import Cancel, NewJob
from service.queue import outbox, table
from service.queue.states import FINAL, State
from service.queue.sweep import hold_office
from service.settings import Settings
from service.store.database import Store, clock
from service.store.models import Batch, Capture, Job
from service.store.tenancy import own_tenant
from service.subjects import repository as subjects
from service.subjects import service as people
from solver.kinds import SCANS

OFFICE = "batches"

log = structlog.get_logger()


def create(session: Session, new: NewBatch, max_attempts: int) -> Batch:
    """Add a session's scans and queue their checks, all of it or nothing."""
    for kind, options in new.options:
        check_options(kind, options, f"options.{kind}")
    if new.subject is not None:
        subject_id = people.create(session, new.subject).id
    else:
        assert new.subject_id is not None, "the schema asks for one of the two"
        subject_id = new.subject_id
    _line_up(session, subject_id)
    added = [scans.create(session, subject_id, capture) for capture in new.captures]
    _refuse_impossible_steps(session, subject_id, new)
    batch = Batch(
        subject_id=subject_id,
        name=new.name,
        capture_ids=[capture.id for capture in added],
        steps=list(new.then),
        options=new.options.model_dump(),
        priority=new.priority,
        created_at=clock(session),
    )
    session.add(batch)
    session.flush()
    for capture in added:
        if capture.role in SCANS:
            _submit(session, batch, max_attempts, CHECK, [capture.id])
    return batch


def cancel(session: Session, batch_id: str, order: Cancel) -> None:
    """Stop a batch and its jobs; asking twice is as good as once."""
    _line_up(session, repository.get(session, batch_id).subject_id)
    batch = repository.lock(session, batch_id)
    if batch.state == "canceled":
        return
    if batch.state != "running":
        raise Problem(409, "batch.finished", f"the batch has {batch.state}", batch_id=batch_id)
    for job in repository.jobs(session, [batch.id]):
        if job.state not in FINAL:
            table.cancel(session, job.id, order.by, order.reason)
    moment = clock(session)
    batch.cancel = {"by": order.by, "reason": order.reason, "requested_at": moment.isoformat()}
    _finish(session, batch, "canceled")


def progress(session: Session, batch: Batch) -> BatchProgress:
    """Return where a batch is."""
    return BatchProgress.of(
        batch, repository.captures(session, batch.capture_ids), repository.jobs(session, [batch.id])
    )


def advance(session: Session, batch_id: str, max_attempts: int) -> None:
    """Queue what a batch needs next, or say how it has ended."""
    _line_up(session, repository.get(session, batch_id).subject_id)
    batch = repository.lock(session, batch_id)
    if batch.state != "running":
        return
    try:
        error, is_over = _advance(session, progress(session, batch), max_attempts)
    except Problem as problem:  # a step that cannot be, whatever has changed meanwhile
        if problem.status == HTTPStatus.TOO_MANY_REQUESTS:
            return  # the tenant's queue is full: later
        error = {"code": problem.code, "message": problem.detail}
        is_over = True
    if is_over:
        batch.error = error
        _finish(session, batch, "failed" if error else "succeeded")


def _advance(
    session: Session, at: BatchProgress, max_attempts: int
) -> tuple[dict[str, Any] | None, bool]:
    """Queue what can be queued; returns an error, if any, and whether the batch is over."""
    batch = at.batch
    neutral_is_ready = _neutral_is_ready(session, at)
    if batch.steps and not neutral_is_ready and (error := _no_neutral(at)):
        return error, True
    is_waiting = False
    for scan in at.scans:
        stand, _ = at.status_of(scan)
        if stand is ScanStatus.TO_REGISTER and (scan.role == "neutral" or neutral_is_ready):
            _submit(session, batch, max_attempts, REGISTER, [scan.id])
        is_waiting |= stand in (ScanStatus.WAITING, ScanStatus.TO_REGISTER)
    if "model" in batch.steps:
        model = at.job(MODEL)
        if model is None and neutral_is_ready:
            _submit(session, batch, max_attempts, MODEL)
        if model is None or model.state not in FINAL:
            return None, False
        if model.state is not State.SUCCEEDED:
            return failure(model), True
    if is_waiting:
        return None, False
    return _fit(session, at, max_attempts) if "geometry" in batch.steps else (None, True)


def _fit(
    session: Session, at: BatchProgress, max_attempts: int
) -> tuple[dict[str, Any] | None, bool]:
    fit = at.job(FIT)
    if fit is not None:
        if fit.state not in FINAL:
            return None, False
        return (None if fit.state is State.SUCCEEDED else failure(fit)), True
    usable = [scan.id for scan in at.expressions if at.status_of(scan)[0] is ScanStatus.READY]
    if not usable:
        return {"code": "batch.no_expression", "message": "no expression can be used"}, True
    _submit(session, at.batch, max_attempts, FIT, usable)
    return None, False


def _neutral_is_ready(session: Session, at: BatchProgress) -> bool:
    """Return whether the subject's neutral, of this batch or an earlier one, is registered."""
    if at.neutral is not None:
        return at.status_of(at.neutral)[0] is ScanStatus.READY
    neutral = captures.neutral(session, at.batch.subject_id)
    return neutral is not None and registered_form(session, neutral) is not None


def _no_neutral(at: BatchProgress) -> dict[str, Any] | None:
    """Return the error of a batch whose neutral will never be ready."""
    if at.neutral is None:
        return {"code": "batch.neutral", "message": "the subject's neutral is gone"}
    stand, reason = at.status_of(at.neutral)
    if stand is not ScanStatus.OUT:
        return None
    message = f"the neutral {at.neutral.name} cannot be used: {reason}"
    return {"code": "batch.neutral", "message": message, "capture_id": at.neutral.id}


def _refuse_impossible_steps(session: Session, subject_id: str, new: NewBatch) -> None:
    """Raise a problem for steps that lack what they would read."""
    neutral = captures.neutral(session, subject_id)
    added = {capture.name for capture in new.captures}
    fault = None
    if new.then and neutral is None:
        fault = "there is no neutral among the captures, nor has the subject one"
    elif new.then and neutral is not None and not _will_be_registered(session, neutral, added, new):
        fault = f"the neutral {neutral.name} is raw and will not be registered"
    elif "geometry" in new.then and not any(c.role == "expression" for c in new.captures):
        fault = "there is no expression among the captures to fit"
    elif "geometry" in new.then and "register" not in new.then:
        raw = [c.name for c in new.captures if c.role == "expression" and not c.registered]
        fault = f"raw scans must be registered first: {', '.join(raw)}" if raw else None
    if fault:
        raise Problem(422, "batch.steps", fault, then=list(new.then))


def _will_be_registered(session: Session, neutral: Capture, added: set[str], new: NewBatch) -> bool:
    if neutral.name in added and not neutral.registered:
        return "register" in new.then
    return registered_form(session, neutral) is not None


def _line_up(session: Session, subject_id: str) -> None:
    """Lock the tenant, then the subject: in the order of all who submit jobs or delete subjects."""
    own_tenant(session, lock=True)
    subjects.lock(session, subject_id)


def _submit(
    session: Session,
    batch: Batch,
    max_attempts: int,
    kind: str,
    capture_ids: list[str] | None = None,
) -> Job:
    new = NewJob(
        kind=kind,
        subject_id=batch.subject_id,
        captures=capture_ids or [],
        options=batch.options[kind],
        priority=batch.priority,
    )
    return work.submit(session, new, max_attempts, batch_id=batch.id)[0]


def _finish(session: Session, batch: Batch, state: str) -> None:
    batch.state = state
    batch.finished_at = clock(session)
    data = {"batch_id": batch.id, "subject_id": batch.subject_id, "state": state}
    outbox.notify(session, batch.tenant_id, "batch.finished", data)


class BatchRunner(Background):
    """A thread that queues what running batches need next, every ``settings.beat`` s.

    One API process of all looks after them, since only the API resolves inputs.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        super().__init__("batches", settings.beat)
        self._store = store
        self._settings = settings
        self._holder = f"{socket.gethostname()}:{os.getpid()}"

    def _round(self) -> None:
        with self._store.read() as session:
            running = repository.list_running(session)
        if not running:
            return
        with self._store.write() as session:
            if not hold_office(session, OFFICE, self._holder, 10 * self._settings.beat):
                return
        for tenant_id, batch_id in running:
            try:
                with self._store.of(tenant_id).write() as session:
                    advance(session, batch_id, self._settings.max_attempts)
            except Problem:
                log.info("batch.gone", batch_id=batch_id)  # deleted with its subject
            except Exception:  # one that cannot go on holds up no other
                log.exception("batch.stuck", batch_id=batch_id)
