"""Lists in pages, newest first: a cursor stands for the last row that was shown."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Generic, TypeVar

from fastapi import Response
from pydantic import BaseModel
from sqlalchemy import Select, and_, or_
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.errors import Problem

Row = TypeVar("Row")
ID = re.compile(r"[0-9A-Za-z-]{1,36}")


@dataclass(frozen=True)
class Slice(Generic[Row]):
    """Rows of a list, and the cursor for those that follow, None after the last."""

    items: list[Row]
    next: str | None


def respond(page: BaseModel) -> Response:
    """Return a page of a list, in the JSON that the model itself writes.

    FastAPI would make Python objects of it first, which takes a third of a long list's time.
    """
    return Response(page.model_dump_json(), media_type="application/json")


def filter_by_labels(
    query: Select[Row], labels: InstrumentedAttribute[dict[str, Any]], wanted: Sequence[str] | None
) -> Select[Row]:
    """Return a query for the rows that have all wanted labels, each ``key:value`` or a key."""
    for each in wanted or ():
        key, colon, value = each.partition(":")
        own = labels[key].as_string()
        query = query.where(own == value.strip() if colon else own.is_not(None))
    return query


def newest(session: Session, query: Select[Row], limit: int, cursor: str | None) -> Slice[Row]:
    """Return a page of a query over a table with ``created_at`` and ``id``.

    A row that is deleted between two pages neither repeats nor hides others.
    """
    table: Any = query.column_descriptions[0]["entity"]
    if cursor is not None:
        created_at, row_id = read_cursor(cursor)
        later = and_(table.created_at == created_at, table.id < row_id)
        query = query.where(or_(table.created_at < created_at, later))
    query = query.order_by(table.created_at.desc(), table.id.desc()).limit(limit + 1)
    rows: list[Any] = list(session.scalars(query))
    following = _write(rows[limit - 1]) if len(rows) > limit else None
    return Slice(rows[:limit], following)


def _write(row: Any) -> str:
    return base64.urlsafe_b64encode(f"{row.created_at.isoformat()} {row.id}".encode()).decode()


def read_cursor(cursor: str) -> tuple[datetime, str]:
    """Return the moment and the id of the row that a cursor stands for."""
    try:
        created_at, row_id = base64.urlsafe_b64decode(cursor).decode().split(" ")
        moment = datetime.fromisoformat(created_at).astimezone(UTC)
        if not ID.fullmatch(row_id):
            raise ValueError(row_id)
    except (ValueError, OverflowError) as error:  # not base64, not two words, no date, no id
        raise Problem(422, "request.cursor", "the cursor is not one of this service's") from error
    return moment, row_id
