"""Tables of records: audit, answered requests, deletions, webhooks."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column, relationship

from service.store.models.base import Base, Owned, new_id, now


class AuditEntry(Owned, Base):
    """Action on an object: ids only, so that the log names nobody it outlives."""

    __tablename__ = "audit"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)
    key_id: Mapped[str] = mapped_column(String(12))
    request_id: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    object_id: Mapped[str] = mapped_column(String(36), index=True)


class AnsweredRequest(Owned, Base):
    """Object that a request with an ``Idempotency-Key`` made, so that its repetition finds it."""

    __tablename__ = "answered_requests"
    tenant_id: Mapped[str] = mapped_column(ForeignKey("tenants.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    object_id: Mapped[str] = mapped_column(String(36))
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)


class Deletion(Owned, Base):
    """The receipt of a deletion.

    ``rows_at``: when the object was gone from the tables (null: its jobs are being stopped).
    ``files_at``: when the last of ``files`` (sha256) that nothing else has was gone, too.
    ``read_by``: ids of the jobs that stay and had read files of it.
    """

    __tablename__ = "deletions"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    kind: Mapped[str] = mapped_column(String(16))
    object_id: Mapped[str] = mapped_column(String(36))
    reason: Mapped[str] = mapped_column(String(16))
    files: Mapped[list[Any]]
    read_by: Mapped[list[Any]] = mapped_column(default=list)
    created_at: Mapped[datetime] = mapped_column(default=now)
    rows_at: Mapped[datetime | None]
    files_at: Mapped[datetime | None] = mapped_column(index=True)


class FileFault(Base):
    """A stored file that was found ``lost`` or ``damaged``, until it is found whole again."""

    __tablename__ = "file_faults"
    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    fault: Mapped[str] = mapped_column(String(16))
    found_at: Mapped[datetime] = mapped_column(default=now)


class Webhook(Owned, Base):
    """An address of a tenant's that is told of ``events`` about jobs of ``kinds`` (empty: all).

    ``generation`` counts the secrets it has had; the one before counts until a day after
    ``rotated_at``. ``failing_since`` is the first failure after the last success.
    """

    __tablename__ = "webhooks"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    url: Mapped[str] = mapped_column(String(2000))
    events: Mapped[list[Any]]
    kinds: Mapped[list[Any]]
    active: Mapped[bool] = mapped_column(default=True)
    disabled_reason: Mapped[str | None] = mapped_column(String(40))
    failing_since: Mapped[datetime | None]
    generation: Mapped[int] = mapped_column(default=1)
    rotated_at: Mapped[datetime | None]
    created_at: Mapped[datetime] = mapped_column(default=now)


class WebhookEvent(Owned, Base):
    """Event as webhooks receive it: ids, never names."""

    __tablename__ = "webhook_events"
    id: Mapped[str] = mapped_column(String(40), primary_key=True)
    type: Mapped[str] = mapped_column(String(40))
    data: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)


class Delivery(Owned, Base):
    """An event on its way to a webhook, and what became of the last try.

    ``state`` is ``pending``, ``delivered`` or ``failed``. A try is under way until ``lease_until``;
    its number is the fence. ``error`` is the code of what went wrong, ``excerpt`` the beginning of
    the answer.
    """

    __tablename__ = "deliveries"
    __table_args__ = (
        Index("ix_deliveries_state_next_at", "state", "next_at"),
        # the next ones of a webhook, and those that are under way
        Index("ix_deliveries_turn", "webhook_id", "state", "next_at"),
        Index("ix_deliveries_under_way", "state", "lease_until"),
    )
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    webhook_id: Mapped[str] = mapped_column(ForeignKey("webhooks.id", ondelete="CASCADE"))
    event_id: Mapped[str] = mapped_column(
        ForeignKey("webhook_events.id", ondelete="CASCADE"), index=True
    )
    state: Mapped[str] = mapped_column(String(16), default="pending")
    attempt: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime | None]
    lease_until: Mapped[datetime | None]
    status: Mapped[int | None]
    ms: Mapped[int | None]
    error: Mapped[str | None] = mapped_column(String(40))
    excerpt: Mapped[str | None] = mapped_column(String(500))
    created_at: Mapped[datetime] = mapped_column(default=now)
    finished_at: Mapped[datetime | None]

    event: Mapped[WebhookEvent] = relationship(lazy="joined", viewonly=True)
