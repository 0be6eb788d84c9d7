"""Routes of API keys; all need the scope `admin`."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from service.access.keys import Keyring
from service.access.principal import Admin
from service.audit.record import record
from service.dependencies import AdminSession, Cursor, Limit, part
from service.errors import problems
from service.idempotency import Once
from service.keys import repository, service
from service.keys.schemas import KeyId, KeyView, KeyWithText, NewKey, Rotation
from service.schemas import Page
from service.store.models import ApiKey

router = APIRouter(prefix="/v1/keys", tags=["keys"])


Keys = Annotated[Keyring, Depends(part("keyring"))]


@router.post("", status_code=201, summary="Make a key", responses=problems(409, 422))
def create(
    new: NewKey, session: AdminSession, who: Admin, keyring: Keys, once: Once, response: Response
) -> KeyWithText:
    """Make a key. The answer holds its text, which is not told again."""
    if (known := once.known(session, new)) is not None:
        return _told(repository.get(session, known), None, response)
    key, text = service.create(session, keyring, new)
    once.keep(session, key.id)
    record(session, who, "key.created", key.id)
    return _told(key, text, response)


@router.get("", response_model=Page[KeyView], summary="List keys", responses=problems(422))
def index(session: AdminSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List keys, newest first, with their last use; also those that open nothing any more."""
    return repository.newest(session, limit, cursor)


@router.post(
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
    if (known := once.known(session, wanted)) is not None:
        return _told(repository.get(session, known), None, response)
    key, text = service.rotate(session, keyring, key_id, wanted.grace)
    once.keep(session, key.id)
    record(session, who, "key.rotated", key_id)
    return _told(key, text, response)


@router.delete(
    "/{key_id}", status_code=204, summary="Revoke a key", responses=problems(404, 409, 422)
)
def revoke(key_id: KeyId, session: AdminSession, who: Admin) -> None:
    """Take a key back at once; the last one with the scope `admin` stays."""
    service.revoke(session, key_id)
    record(session, who, "key.revoked", key_id)


def _told(key: ApiKey, text: str | None, response: Response) -> KeyWithText:
    response.headers["Cache-Control"] = "no-store"
    return KeyWithText.model_validate({**KeyView.model_validate(key).model_dump(), "key": text})
