"""Routes of webhooks and their deliveries; all need the scope `webhooks`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Query, Response

from service.access.principal import Hooks
from service.dependencies import Cursor, HookSession, Limit, part
from service.errors import problems
from service.idempotency import Once
from service.outbound import Sender
from service.records.audit import record
from service.schemas import Id, Page
from service.store.database import clock
from service.store.models import Webhook
from service.webhooks import repository, service, signing
from service.webhooks.schemas import (
    DeliveryView,
    NewWebhook,
    WebhookChange,
    WebhookView,
    WebhookWithSecret,
)

router = APIRouter(prefix="/v1", tags=["webhooks"])


Master = Annotated[bytes, Depends(part("master"))]
SenderDep = Annotated[Sender, Depends(part("sender"))]


@router.post("/webhooks", status_code=201, summary="Add a webhook", responses=problems(409, 422))
def create(
    new: NewWebhook,
    session: HookSession,
    who: Hooks,
    sender: SenderDep,
    master: Master,
    once: Once,
    response: Response,
) -> WebhookWithSecret:
    """Have an address told what happens. The answer holds the secret, which is not told again."""
    response.headers["Cache-Control"] = "no-store"
    if (known := once.find_answered(session, new)) is not None:
        response.headers["Location"] = f"/v1/webhooks/{known}"
        return _with_secret(repository.get(session, known), None)
    webhook = service.create(session, sender, new)
    once.keep(session, webhook.id)
    record(session, who, "webhook.created", webhook.id)
    response.headers["Location"] = f"/v1/webhooks/{webhook.id}"
    return _with_secret(webhook, master)


@router.get(
    "/webhooks", response_model=Page[WebhookView], summary="List webhooks", responses=problems(422)
)
def index(session: HookSession, limit: Limit = 100, cursor: Cursor = None) -> Any:
    """List webhooks, newest first."""
    return repository.newest(session, limit, cursor)


@router.get(
    "/webhooks/{webhook_id}",
    response_model=WebhookView,
    summary="Show a webhook",
    responses=problems(404, 422),
)
def show(webhook_id: Id, session: HookSession) -> Any:
    """Show a webhook, and whether it works."""
    return repository.get(session, webhook_id)


@router.patch(
    "/webhooks/{webhook_id}",
    response_model=WebhookView,
    summary="Change a webhook",
    responses=problems(404, 422),
)
def change(
    webhook_id: Id, order: WebhookChange, session: HookSession, who: Hooks, sender: SenderDep
) -> Any:
    """Change address or filter, or switch it off and on."""
    webhook = service.change(session, sender, webhook_id, order)
    record(session, who, "webhook.changed", webhook_id)
    return webhook


@router.delete(
    "/webhooks/{webhook_id}",
    status_code=204,
    summary="Delete a webhook",
    responses=problems(404, 422),
)
def delete(webhook_id: Id, session: HookSession, who: Hooks) -> None:
    """Delete a webhook with its log."""
    session.delete(repository.get(session, webhook_id))
    record(session, who, "webhook.deleted", webhook_id)


@router.post(
    "/webhooks/{webhook_id}/rotate",
    summary="Give a webhook a new secret",
    responses=problems(404, 409, 422),
)
def rotate(
    webhook_id: Id, session: HookSession, who: Hooks, master: Master, once: Once
) -> WebhookWithSecret:
    """Make a new secret; for a day the old one signs too, so that receivers can change over."""
    if once.find_answered(session) is not None:
        return _with_secret(repository.get(session, webhook_id), None)
    webhook = service.rotate(session, webhook_id, clock(session))
    once.keep(session, webhook_id)
    record(session, who, "webhook.rotated", webhook_id)
    return _with_secret(webhook, master)


@router.post(
    "/webhooks/{webhook_id}/test",
    status_code=202,
    summary="Try a webhook",
    responses=problems(404, 409, 422),
)
def test(webhook_id: Id, session: HookSession) -> DeliveryView:
    """Send a `webhook.test`; the delivery tells how it went."""
    return DeliveryView.of(service.test(session, webhook_id))


@router.get(
    "/webhooks/{webhook_id}/deliveries",
    summary="Read a webhook's log",
    responses=problems(404, 422),
)
def deliveries(
    webhook_id: Id,
    session: HookSession,
    state: Annotated[Literal["pending", "delivered", "failed"] | None, Query()] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[DeliveryView]:
    """Read what was sent in the last 30 days and what became of it, newest first."""
    repository.get(session, webhook_id)
    found = repository.deliveries(session, webhook_id, state, limit, cursor)
    return Page(items=[DeliveryView.of(each) for each in found.items], next=found.next)


@router.get("/deliveries/{delivery_id}", summary="Show a delivery", responses=problems(404, 422))
def delivery(delivery_id: Id, session: HookSession) -> DeliveryView:
    """Show an event on its way, or what became of it."""
    return DeliveryView.of(repository.delivery(session, delivery_id))


@router.post(
    "/deliveries/{delivery_id}/redeliver",
    status_code=202,
    summary="Send an event again",
    responses=problems(404, 409, 422),
)
def redeliver(delivery_id: Id, session: HookSession) -> DeliveryView:
    """Send an event to its webhook once more, with the same id."""
    return DeliveryView.of(service.redeliver(session, delivery_id))


def _with_secret(webhook: Webhook, master: bytes | None) -> WebhookWithSecret:
    """Show a webhook with its present secret; without ``master`` it is not told again."""
    shown = WebhookView.model_validate(webhook).model_dump()
    secret = signing.secret(master, webhook.id, webhook.generation) if master else None
    return WebhookWithSecret(**shown, secret=secret)
