"""Routes of templates."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from service.dependencies import Cursor, Limit, ReadSession, WriteSession
from service.errors import problems
from service.schemas import Id, Page
from service.templates import repository, service
from service.templates.schemas import NewTemplate, TemplateView

router = APIRouter(prefix="/v1/templates", tags=["templates"])


@router.post(
    "",
    status_code=201,
    response_model=TemplateView,
    summary="Bring a template anatomy",
    responses=problems(404, 409, 410, 422),
)
def create(new: NewTemplate, session: WriteSession) -> Any:
    """Make a template anatomy of a complete upload (`.npz`)."""
    return service.create(session, new)


@router.get(
    "", response_model=Page[TemplateView], summary="List templates", responses=problems(422)
)
def index(session: ReadSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List templates, newest first."""
    return repository.newest(session, limit, cursor)


@router.get(
    "/{template_id}",
    response_model=TemplateView,
    summary="Show a template",
    responses=problems(404, 422),
)
def show(template_id: Id, session: ReadSession) -> Any:
    """Show a template."""
    return repository.get(session, template_id)
