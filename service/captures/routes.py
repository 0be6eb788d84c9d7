"""Routes of captures."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from service.captures import repository, service
from service.captures.schemas import CaptureView, NewCapture
from service.dependencies import ReadSession, WriteSession
from service.errors import problems
from service.schemas import Id, Page
from service.subjects import repository as subjects

router = APIRouter(prefix="/v1/subjects/{subject_id}/captures", tags=["captures"])


@router.post(
    "",
    status_code=201,
    response_model=CaptureView,
    summary="Add a scan",
    responses=problems(404, 409, 410, 422),
)
def create(subject_id: Id, new: NewCapture, session: WriteSession) -> Any:
    """Make a complete upload (OBJ, PLY, GLB or STL) the subject's neutral or an expression."""
    return service.create(session, subject_id, new)


@router.get(
    "",
    response_model=Page[CaptureView],
    summary="List a subject's scans",
    responses=problems(404, 422),
)
def index(subject_id: Id, session: ReadSession) -> Any:
    """List a subject's captures, newest first."""
    subjects.get(session, subject_id)
    return {"items": repository.of_subject(session, subject_id)}


@router.delete(
    "/{capture_id}",
    status_code=204,
    summary="Delete a scan",
    responses=problems(404, 409, 422),
)
def delete(subject_id: Id, capture_id: Id, session: WriteSession) -> None:
    """Delete a capture, for example to replace a bad scan."""
    service.delete(session, subject_id, capture_id)
