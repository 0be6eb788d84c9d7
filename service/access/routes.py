"""Routes of API keys (scope `admin`), and of the caller and its tenant."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from service.access import keys, limits
from service.access.keys import Keyring
from service.access.principal import Admin, Reader, Scope
from service.access.schemas import KeyId, KeyView, KeyWithText, Me, NewKey, Rotation, Usage, Use
from service.dependencies import AdminSession, Cursor, Limit, ReadSession, part
from service.errors import problems
from service.idempotency import Once
from service.records.audit import record
from service.schemas import Page
from service.store.integrity import faults, holders
from service.store.models import ApiKey
from service.store.tenancy import own_tenant
from service.store.usage import stored_bytes

keys_router = APIRouter(prefix="/v1/keys", tags=["keys"])


Keys = Annotated[Keyring, Depends(part("keyring"))]


@keys_router.post("", status_code=201, summary="Make a key", responses=problems(403, 409, 422))
def create(
    new: NewKey, session: AdminSession, who: Admin, keyring: Keys, once: Once, response: Response
) -> KeyWithText:
    """Make a key. The answer holds its text, which is not shown again."""
    if (known := once.find_answered(session, new)) is not None:
        return _show_key(keys.get(session, known), None, response)
    key, text = keys.create(session, keyring, new, who)
    once.keep(session, key.id)
    record(session, who, "key.created", key.id)
    return _show_key(key, text, response)


@keys_router.get("", response_model=Page[KeyView], summary="List keys", responses=problems(422))
def index(session: AdminSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List keys, newest first, with their last use; also those that open nothing any more."""
    return keys.newest(session, limit, cursor)


@keys_router.post(
    "/{key_id}/rotate", status_code=201, summary="Replace a key", responses=problems(404, 409, 422)
)
def rotate(
    key_id: KeyId,
    session: AdminSession,
    who: Admin,
    keyring: Keys,
    once: Once,
    response: Response,
    order: Rotation | None = None,
) -> KeyWithText:
    """Make a key of the same name, scopes and end; the old one goes on for `grace` seconds."""
    wanted = order or Rotation()
    if (known := once.find_answered(session, wanted)) is not None:
        return _show_key(keys.get(session, known), None, response)
    key, text = keys.rotate(session, keyring, key_id, wanted.grace, who)
    once.keep(session, key.id)
    record(session, who, "key.rotated", key_id)
    return _show_key(key, text, response)


@keys_router.delete(
    "/{key_id}", status_code=204, summary="Revoke a key", responses=problems(404, 409, 422)
)
def revoke(key_id: KeyId, session: AdminSession, who: Admin) -> None:
    """Take a key back at once; the last one with the scope `admin` stays."""
    keys.revoke(session, key_id)
    record(session, who, "key.revoked", key_id)


def _show_key(key: ApiKey, text: str | None, response: Response) -> KeyWithText:
    response.headers["Cache-Control"] = "no-store"
    return KeyWithText.model_validate({**KeyView.model_validate(key).model_dump(), "key": text})


tenants_router = APIRouter(prefix="/v1", tags=["tenants"])


@tenants_router.get("/me", summary="Whose key is this?")
def me(who: Reader, session: ReadSession) -> Me:
    """Show the tenant, the id and the scopes of the key."""
    scopes = sorted(map(Scope, who.scopes))
    return Me(tenant=own_tenant(session).name, key_id=who.key_id, scopes=scopes)


@tenants_router.get("/usage", summary="What the tenant uses")
def usage(session: ReadSession) -> Usage:
    """Show how much is stored, queued and running, and the quotas."""
    tenant = own_tenant(session)
    return Usage(
        bytes=Use(used=stored_bytes(session, tenant.id), limit=tenant.max_bytes),
        queued=Use(used=limits.count_queued(session), limit=limits.most_queued(tenant)),
        running=Use(used=limits.count_running(session), limit=tenant.max_running),
        lost_files=len(holders(session, faults(session))),
    )
