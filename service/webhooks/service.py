"""Webhook operations: create, change, rotate, test, redeliver, delete."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy.orm import Session

from service.errors import Problem
from service.outbound import Refused, Sender
from service.queue import outbox
from service.store.database import clock
from service.store.models import Delivery, Webhook
from service.store.tenancy import own_tenant
from service.webhooks import repository
from service.webhooks.schemas import NewWebhook, WebhookChange

# Most webhooks of a tenant: each is looked at with every step of every job
MOST = 20

BY_USER = "by_user"


def create(session: Session, sender: Sender, new: NewWebhook) -> Webhook:
    """Add a webhook that ``sender`` may call."""
    own_tenant(session, lock=True)  # two at a time would both count one less
    if repository.count(session) >= MOST:
        raise Problem(409, "webhook.too_many", f"there are {MOST} webhooks already", expected=MOST)
    _refuse_inner(new.url, sender)
    webhook = Webhook(url=new.url, events=new.events, kinds=new.kinds, created_at=clock(session))
    session.add(webhook)
    session.flush()
    return webhook


def change(session: Session, sender: Sender, webhook_id: str, order: WebhookChange) -> Webhook:
    """Change a webhook; switching it on, or to another address, forgets that it failed."""
    webhook = repository.get(session, webhook_id, lock=True)
    if order.url is not None:
        _refuse_inner(order.url, sender)
    changes = order.model_dump(exclude_unset=True)
    active = changes.pop("active", None)
    for name, value in changes.items():
        setattr(webhook, name, value)
    if active or "url" in changes:
        webhook.failing_since = None
    if active:
        webhook.active = True
        webhook.disabled_reason = None
    elif active is False and webhook.active:
        session.flush()
        outbox.switch_off(session, webhook.id, BY_USER, clock(session))
        session.refresh(webhook)
    session.flush()
    return webhook


def rotate(session: Session, webhook_id: str, moment: datetime) -> Webhook:
    """Give a webhook a new secret; the one before signs beside it for a day."""
    webhook = repository.get(session, webhook_id, lock=True)
    webhook.generation += 1
    webhook.rotated_at = moment
    session.flush()
    return webhook


def test(session: Session, webhook_id: str) -> Delivery:
    """Send an event that means nothing, whatever the webhook asks for."""
    webhook = _active(repository.get(session, webhook_id))
    [delivery] = outbox.send(session, [webhook], outbox.TEST, {"webhook_id": webhook.id})
    return delivery


def redeliver(session: Session, delivery_id: str) -> Delivery:
    """Send what was sent before once more, with the same event id."""
    delivery = repository.delivery(session, delivery_id)
    webhook = _active(repository.get(session, delivery.webhook_id))
    return outbox.send_again(session, webhook.id, delivery.event, clock(session))


def _refuse_inner(url: str, sender: Sender) -> None:
    try:
        sender.check(url)
    except Refused as refusal:
        raise Problem(422, "webhook.url", str(refusal), reason=refusal.code) from refusal


def _active(webhook: Webhook) -> Webhook:
    if not webhook.active:
        raise Problem(
            409,
            "webhook.inactive",
            "the webhook is switched off; switch it on first",
            webhook_id=webhook.id,
            reason=webhook.disabled_reason,
        )
    return webhook
