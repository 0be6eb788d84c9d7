"""Routes of subjects."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from service.dependencies import Cursor, DeleteSession, Limit, ReadSession, WriteSession
from service.errors import problems
from service.schemas import Id, Page
from service.subjects import repository, service
from service.subjects.schemas import NewSubject, SubjectView

router = APIRouter(prefix="/v1/subjects", tags=["subjects"])


@router.post(
    "",
    status_code=201,
    response_model=SubjectView,
    summary="Add a subject",
    responses=problems(404, 422),
)
def create(new: NewSubject, session: WriteSession) -> Any:
    """Add a person to be scanned."""
    return service.create(session, new)


@router.get("", response_model=Page[SubjectView], summary="List subjects", responses=problems(422))
def index(session: ReadSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List subjects, newest first."""
    return repository.newest(session, limit, cursor)


@router.get(
    "/{subject_id}",
    response_model=SubjectView,
    summary="Show a subject",
    responses=problems(404, 422),
)
def show(subject_id: Id, session: ReadSession) -> Any:
    """Show a subject."""
    return repository.get(session, subject_id)


@router.delete(
    "/{subject_id}",
    status_code=204,
    summary="Delete a subject",
    responses=problems(404, 409, 422),
)
def delete(subject_id: Id, session: DeleteSession) -> None:
    """Delete a subject with its captures, jobs, rigs and their files (files within minutes)."""
    service.delete(session, subject_id)
