"""Routes of subjects."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response

from service.access.principal import Deleter, Writer
from service.dependencies import (
    Cursor,
    DeleteSession,
    Limit,
    ReadSession,
    SettingsDep,
    WithLabels,
    WriteSession,
)
from service.errors import problems
from service.idempotency import Once
from service.records.audit import record
from service.records.routes import answer_deletion
from service.schemas import Id, Page
from service.store.retention import own_days
from service.subjects import repository, service
from service.subjects.schemas import NewSubject, SubjectChange, SubjectView

router = APIRouter(prefix="/v1/subjects", tags=["subjects"])


@router.post("", status_code=201, summary="Add a subject", responses=problems(404, 409, 422))
def create(
    new: NewSubject, session: WriteSession, who: Writer, once: Once, settings: SettingsDep
) -> SubjectView:
    """Add a person to be scanned."""
    if (known := once.find_answered(session, new)) is not None:
        return SubjectView.of(repository.get(session, known), own_days(session, settings))
    subject = service.create(session, new)
    once.keep(session, subject.id)
    record(session, who, "subject.created", subject.id)
    return SubjectView.of(subject, own_days(session, settings))


@router.get("", summary="List subjects", responses=problems(422))
def index(
    session: ReadSession,
    settings: SettingsDep,
    label: WithLabels = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[SubjectView]:
    """List subjects, newest first."""
    found = repository.newest(session, label, limit, cursor)
    kept = own_days(session, settings)
    items = [SubjectView.of(subject, kept) for subject in found.items]
    return Page(items=items, next=found.next)


@router.get("/{subject_id}", summary="Show a subject", responses=problems(404, 422))
def show(subject_id: Id, session: ReadSession, settings: SettingsDep) -> SubjectView:
    """Show a subject."""
    return SubjectView.of(repository.get(session, subject_id), own_days(session, settings))


@router.patch("/{subject_id}", summary="Change a subject", responses=problems(404, 422))
def change(
    subject_id: Id, order: SubjectChange, session: WriteSession, who: Writer, settings: SettingsDep
) -> SubjectView:
    """Give a person another name or other labels, also while jobs run."""
    subject = service.change(session, subject_id, order)
    record(session, who, "subject.changed", subject_id)
    return SubjectView.of(subject, own_days(session, settings))


@router.delete(
    "/{subject_id}",
    status_code=204,
    summary="Delete a subject",
    responses={202: {"description": "Its jobs are being stopped"}, **problems(404, 409, 422)},
)
def delete(
    subject_id: Id,
    session: DeleteSession,
    who: Deleter,
    cancel: Annotated[bool, Query(description="stop its jobs first")] = False,
) -> Response:
    """Delete a subject with its captures, jobs, rigs and their files (files within minutes).

    `Location` names the receipt, which says when all was gone.
    """
    receipt = service.delete(session, subject_id, cancel=cancel)
    record(session, who, "subject.deleted", subject_id)
    return answer_deletion(receipt)
