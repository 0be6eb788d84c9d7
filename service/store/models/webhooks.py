"""The tables of webhooks: who is told, what happened, and how telling went."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column, relationship

from service.store.models.base import Base, Owned, new_id, now


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
    """Something that happened, as it is told: ids, never names."""

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
    __table_args__ = (Index("ix_deliveries_state_next_at", "state", "next_at"),)
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    webhook_id: Mapped[str] = mapped_column(
        ForeignKey("webhooks.id", ondelete="CASCADE"), index=True
    )
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
