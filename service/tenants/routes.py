"""Routes about the caller and its tenant."""

from __future__ import annotations

from fastapi import APIRouter

from service.access import quotas
from service.access.principal import Reader, Scope
from service.dependencies import ReadSession
from service.store.tenancy import own_tenant
from service.tenants.schemas import Me, Usage, Use

router = APIRouter(prefix="/v1", tags=["tenants"])


@router.get("/me", summary="Whose key is this?")
def me(who: Reader, session: ReadSession) -> Me:
    """Tell the tenant, the id and the scopes of the key."""
    scopes = sorted(map(Scope, who.scopes))
    return Me(tenant=own_tenant(session).name, key_id=who.key_id, scopes=scopes)


@router.get("/usage", summary="What the tenant uses")
def usage(session: ReadSession) -> Usage:
    """Tell how much is stored, queued and running, and the quotas."""
    tenant = own_tenant(session)
    return Usage(
        bytes=Use(used=quotas.stored_bytes(session, tenant.id), limit=tenant.max_bytes),
        queued=Use(used=quotas.queued(session), limit=tenant.max_queued),
        running=Use(used=quotas.running(session), limit=tenant.max_running),
    )
