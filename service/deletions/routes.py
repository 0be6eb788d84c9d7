"""Routes of deletions, and what the answer of a `DELETE` says."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Response
from sqlalchemy import select

from service import paging
from service.deletions.schemas import DeletionView
from service.dependencies import Cursor, Limit, ReadSession
from service.errors import problems, unknown
from service.schemas import Id, Page
from service.store.models import Deletion

router = APIRouter(prefix="/v1/deletions", tags=["deletions"])


def answer(receipt: Deletion) -> Response:
    """Return the answer of a deletion: 204, or 202 while jobs are being stopped."""
    location = {"Location": f"/v1/deletions/{receipt.id}"}
    return Response(status_code=202 if receipt.rows_at is None else 204, headers=location)


@router.get(
    "", response_model=Page[DeletionView], summary="List deletions", responses=problems(422)
)
def index(session: ReadSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List what was deleted, by request or because it had been kept long enough."""
    return paging.newest(session, select(Deletion), limit, cursor)


@router.get(
    "/{deletion_id}",
    response_model=DeletionView,
    summary="Show a deletion",
    responses=problems(404, 422),
)
def show(deletion_id: Id, session: ReadSession) -> Any:
    """Show how far a deletion is; files go within minutes."""
    receipt = session.get(Deletion, deletion_id)
    if receipt is None:
        raise unknown("deletion", deletion_id)
    return receipt
