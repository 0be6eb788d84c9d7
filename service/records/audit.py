"""Writing the audit log."""

from __future__ import annotations

from sqlalchemy.orm import Session

from service.access.principal import Principal
from service.store.database import clock
from service.store.models import AuditEntry


def record(session: Session, who: Principal, action: str, object_id: str) -> None:
    """Write down that ``who`` did ``action``, in the transaction of what was done.

    Ids only: the log outlives the people it is about, and must not keep their names.
    """
    session.add(
        AuditEntry(
            tenant_id=who.tenant_id,
            key_id=who.key_id,
            request_id=who.request_id,
            action=action,
            object_id=object_id,
            created_at=clock(session),
        )
    )
