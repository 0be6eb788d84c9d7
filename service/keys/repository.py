"""The table of API keys."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import ColumnElement, or_, select
from sqlalchemy.orm import Session

from service import paging
from service.access.principal import Scope
from service.errors import unknown
from service.paging import Slice
from service.store.models import ApiKey


def get(session: Session, key_id: str) -> ApiKey:
    """Return a key."""
    key = session.get(ApiKey, key_id)
    if key is None:
        raise unknown("key", key_id)
    return key


def newest(session: Session, limit: int, cursor: str | None) -> Slice[ApiKey]:
    """Return keys, newest first, also those that open nothing any more."""
    return paging.newest(session, select(ApiKey), limit, cursor)


def other_admins(session: Session, key: ApiKey) -> Iterable[str]:
    """Return the ids of the further keys that may make keys for as long as ``key`` could."""
    lasting: ColumnElement[bool] = ApiKey.expires_at.is_(None)
    if key.expires_at is not None:
        lasting = or_(lasting, ApiKey.expires_at >= key.expires_at)
    # one that has given way to another lives on for a grace only
    living = select(ApiKey).where(ApiKey.id != key.id, ApiKey.revoked_at.is_(None), lasting)
    return [other.id for other in session.scalars(living) if Scope.ADMIN in other.scopes]
