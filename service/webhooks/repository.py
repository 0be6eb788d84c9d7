"""The tables of webhooks and deliveries."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.store.models import Delivery, Webhook


def get(session: Session, webhook_id: str, *, lock: bool = False) -> Webhook:
    """Return a webhook; with ``lock`` nobody else changes it until the commit."""
    query = select(Webhook).where(Webhook.id == webhook_id)
    webhook = session.scalars(query.with_for_update() if lock else query).one_or_none()
    if webhook is None:
        raise not_found("webhook", webhook_id)
    return webhook


def newest(session: Session, limit: int, cursor: str | None) -> Slice[Webhook]:
    """Return webhooks, newest first."""
    return paging.newest(session, select(Webhook), limit, cursor)


def count(session: Session) -> int:
    """Count the session's tenant's webhooks."""
    return session.execute(select(func.count(Webhook.id))).scalar_one()


def deliveries(
    session: Session, webhook_id: str, state: str | None, limit: int, cursor: str | None
) -> Slice[Delivery]:
    """Return a webhook's deliveries, newest first."""
    query = select(Delivery).where(Delivery.webhook_id == webhook_id)
    if state is not None:
        query = query.where(Delivery.state == state)
    return paging.newest(session, query, limit, cursor)


def delivery(session: Session, delivery_id: str) -> Delivery:
    """Return a delivery."""
    found = session.scalars(select(Delivery).where(Delivery.id == delivery_id)).one_or_none()
    if found is None:
        raise not_found("delivery", delivery_id)
    return found
