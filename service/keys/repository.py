"""The table of API keys."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from service import paging
from service.access.principal import Scope
from service.errors import unknown
from service.paging import Slice
from service.store.database import clock
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


def other_admins(session: Session, key_id: str) -> Iterable[str]:
    """Return the ids of the further keys that may make keys."""
    moment = clock(session)
    living = select(ApiKey).where(
        ApiKey.id != key_id,
        or_(ApiKey.revoked_at.is_(None), ApiKey.revoked_at > moment),
        or_(ApiKey.expires_at.is_(None), ApiKey.expires_at > moment),
    )
    return [key.id for key in session.scalars(living) if Scope.ADMIN in key.scopes]
