"""The table of tenants, for whoever runs the service."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.store.models import Tenant


def all_of_them(session: Session) -> Sequence[Tenant]:
    """Return the tenants, the oldest first."""
    return session.scalars(select(Tenant).order_by(Tenant.created_at)).all()


def change(session: Session, tenant_id: str, **limits: int | None) -> bool:
    """Set a tenant's quotas or days of retention; False: there is no such tenant."""
    tenant = session.get(Tenant, tenant_id, with_for_update=True)
    if tenant is None:
        return False
    for name, most in limits.items():
        setattr(tenant, name, most)
    return True
