"""The one policy of whose rows a session sees: those of its tenant, in every statement.

A session of the service itself (the sweeper, a worker) has no tenant and sees all of them.
"""

from __future__ import annotations

from typing import Any

from sqlalchemy import event
from sqlalchemy.orm import ORMExecuteState, Session, with_loader_criteria

from service.store.models import Owned, Tenant

TENANT = "tenant"


def tenant_of(session: Session) -> str | None:
    """Return the tenant whose session this is; None: the service's own."""
    tenant: str | None = session.info.get(TENANT)
    return tenant


def own_tenant(session: Session, *, lock: bool = False) -> Tenant:
    """Return the tenant whose session this is; with ``lock``, others with it wait.

    The lock is the one that does not keep rows which refer to the tenant from being added.
    """
    locking = {"key_share": True} if lock else None
    return session.get_one(Tenant, tenant_of(session), with_for_update=locking)


@event.listens_for(Session, "do_orm_execute")
def _see_only_own_rows(state: ORMExecuteState) -> None:
    tenant = tenant_of(state.session)
    if tenant is None or state.is_column_load or state.is_relationship_load:
        return  # a row that is loaded brings its own columns, and rows of its own tenant
    state.statement = state.statement.options(
        with_loader_criteria(Owned, lambda table: table.tenant_id == tenant, include_aliases=True)
    )


@event.listens_for(Session, "before_flush")
def _own_new_rows(session: Session, _context: Any, _instances: Any) -> None:
    tenant = tenant_of(session)
    if tenant is None:
        return
    for row in session.new:
        if isinstance(row, Owned):
            row.tenant_id = tenant
