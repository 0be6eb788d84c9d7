"""What can be done with API keys."""

from __future__ import annotations

from datetime import timedelta

from sqlalchemy.orm import Session

from service.access.keys import Keyring
from service.access.principal import Scope
from service.errors import Problem
from service.keys import repository
from service.keys.schemas import NewKey
from service.store.database import clock
from service.store.models import ApiKey
from service.store.tenancy import own_tenant


def create(session: Session, keyring: Keyring, new: NewKey) -> tuple[ApiKey, str]:
    """Make a key; returns it and its text."""
    if new.expires_at is not None and new.expires_at <= clock(session):
        raise Problem(422, "key.expired", "a new key can not have expired", field="expires_at")
    tenant = own_tenant(session)
    return keyring.mint(session, tenant.id, new.name, set(new.scopes), new.expires_at)


def rotate(session: Session, keyring: Keyring, key_id: str, grace: int) -> tuple[ApiKey, str]:
    """Make a key in place of one that goes on to work for ``grace`` seconds."""
    tenant = own_tenant(session, lock=True)
    old, moment = repository.get(session, key_id), clock(session)
    if _is_over(old, session):
        raise Problem(409, "key.over", "the key opens nothing any more", key_id=key_id)
    fresh, text = keyring.mint(session, tenant.id, old.name, old.scopes, old.expires_at)
    until = moment + timedelta(seconds=grace)
    old.expires_at = min(filter(None, (old.expires_at, until)))
    return fresh, text


def revoke(session: Session, key_id: str) -> None:
    """Take a key back; again is as good as once.

    Raises
    ------
    Problem
        409 for the last key that can make others.
    """
    own_tenant(session, lock=True)  # two at a time would each leave the other
    key = repository.get(session, key_id)
    if _is_over(key, session):
        return
    if Scope.ADMIN in key.scopes and not repository.other_admins(session, key):
        raise Problem(409, "key.last_admin", "no other key could make keys then", key_id=key_id)
    key.revoked_at = clock(session)


def _is_over(key: ApiKey, session: Session) -> bool:
    ends = [moment for moment in (key.revoked_at, key.expires_at) if moment is not None]
    return any(moment <= clock(session) for moment in ends)
