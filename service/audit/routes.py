"""The route of the audit log."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query
from sqlalchemy import select

from service import paging
from service.audit.schemas import AuditEntryView
from service.dependencies import AdminSession, Cursor, Limit
from service.errors import problems
from service.schemas import Page
from service.store.models import AuditEntry

router = APIRouter(prefix="/v1/audit", tags=["audit"])

ObjectId = Annotated[
    str | None, Query(max_length=36, pattern=r"^[0-9A-Za-z-]*$", description="only about this one")
]


@router.get(
    "",
    response_model=Page[AuditEntryView],
    summary="Read the audit log",
    responses=problems(422),
)
def index(
    session: AdminSession, object_id: ObjectId = None, limit: Limit = 100, cursor: Cursor = None
) -> Any:
    """List what was done with the tenant's keys, newest first."""
    query = select(AuditEntry)
    if object_id is not None:
        query = query.where(AuditEntry.object_id == object_id)
    return paging.newest(session, query, limit, cursor)
