"""Routes of templates."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response

from service.access.principal import Deleter, Writer
from service.dependencies import Cursor, DeleteSession, Limit, ReadSession, WriteSession, WriteStore
from service.errors import problems
from service.idempotency import Once
from service.records.audit import record
from service.records.routes import answer_deletion
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
def create(
    new: NewTemplate, session: WriteSession, store: WriteStore, who: Writer, once: Once
) -> Any:
    """Make a template anatomy of a complete upload (`.npz`)."""
    if (known := once.find_answered(session, new)) is not None:
        return repository.get(session, known)
    template = service.create(session, store.files, new)
    once.keep(session, template.id)
    record(session, who, "template.created", template.id)
    return template


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


@router.delete(
    "/{template_id}",
    status_code=204,
    summary="Delete a template",
    responses=problems(404, 409, 422),
)
def delete(template_id: Id, session: DeleteSession, who: Deleter) -> Response:
    """Delete a template that no subject has; models built of it stay."""
    receipt = service.delete(session, template_id)
    record(session, who, "template.deleted", template_id)
    return answer_deletion(receipt)
