"""Routes of the audit log and of deletions, and the answer of a `DELETE`."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response
from sqlalchemy import select

from service import paging
from service.dependencies import AdminSession, Cursor, Limit, ReadSession
from service.errors import not_found, problems
from service.records.schemas import AuditEntryView, DeletionView
from service.schemas import Id, Page
from service.store.models import AuditEntry, Deletion

audit_router = APIRouter(prefix="/v1/audit", tags=["audit"])

ObjectId = Annotated[
    str | None, Query(max_length=36, pattern=r"^[0-9A-Za-z-]*$", description="only about this one")
]


@audit_router.get(
    "",
    name="index",
    response_model=Page[AuditEntryView],
    summary="Read the audit log",
    responses=problems(422),
)
def read_audit(
    session: AdminSession, object_id: ObjectId = None, limit: Limit = 100, cursor: Cursor = None
) -> Any:
    """List what was done with the tenant's keys, newest first."""
    query = select(AuditEntry)
    if object_id is not None:
        query = query.where(AuditEntry.object_id == object_id)
    return paging.newest(session, query, limit, cursor)


deletions_router = APIRouter(prefix="/v1/deletions", tags=["deletions"])


def answer_deletion(receipt: Deletion) -> Response:
    """Return the answer of a deletion: 204, or 202 while jobs are being stopped."""
    location = {"Location": f"/v1/deletions/{receipt.id}"}
    return Response(status_code=202 if receipt.rows_at is None else 204, headers=location)


@deletions_router.get(
    "", response_model=Page[DeletionView], summary="List deletions", responses=problems(422)
)
def index(session: ReadSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List what was deleted, by request or because it had been kept long enough."""
    return paging.newest(session, select(Deletion), limit, cursor)


@deletions_router.get(
    "/{deletion_id}",
    response_model=DeletionView,
    summary="Show a deletion",
    responses=problems(404, 422),
)
def show(deletion_id: Id, session: ReadSession) -> Any:
    """Show how far a deletion is; files go within minutes."""
    receipt = session.get(Deletion, deletion_id)
    if receipt is None:
        raise not_found("deletion", deletion_id)
    return receipt
