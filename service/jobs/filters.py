"""Which jobs a list shows."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Query
from sqlalchemy import ColumnElement

from service.schemas import Id, Moment, Name
from service.store.models import Job
from service.store.transitions import State


async def _filters(
    subject_id: Annotated[Id | None, Query()] = None,
    capture_id: Annotated[Id | None, Query(description="checks and registrations of it")] = None,
    batch_id: Annotated[Id | None, Query()] = None,
    parent_id: Annotated[Id | None, Query(description="jobs made again from it")] = None,
    kind: Name | None = None,
    state: Annotated[
        list[State] | None, Query(description="one of these; may be given several times")
    ] = None,
    since: Annotated[Moment | None, Query(description="created then or later")] = None,
    until: Annotated[Moment | None, Query(description="created before then")] = None,
) -> list[ColumnElement[bool]]:
    """Return what the jobs must fulfil, all that was given."""
    equal: dict[Any, object] = {
        Job.subject_id: subject_id,
        Job.capture_id: capture_id,
        Job.batch_id: batch_id,
        Job.parent_id: parent_id,
        Job.kind: kind,
    }
    conditions = [column == value for column, value in equal.items() if value is not None]
    if state:
        conditions.append(Job.state.in_(state))
    if since is not None:
        conditions.append(Job.created_at >= since)
    if until is not None:
        conditions.append(Job.created_at < until)
    return conditions


Filters = Annotated[list[ColumnElement[bool]], Depends(_filters)]
