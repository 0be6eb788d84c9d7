"""Bodies and views of webhooks."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from service.outbound import LONGEST_URL, Refused, parse
from service.schemas import Change, RequestBody, View
from service.store.models import Delivery
from solver.kinds import KINDS

# Events that a webhook can subscribe to
EventType = Literal[
    "job.started", "job.succeeded", "job.failed", "job.canceled", "scan.checked", "batch.finished"
]


def _sendable(url: str) -> str:
    try:
        parse(url)
    except Refused as refusal:
        raise ValueError(str(refusal)) from refusal
    return url


def _known(kinds: list[str]) -> list[str]:
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise ValueError(f"there is no kind of job {unknown[0]!r}")
    return kinds


Url = Annotated[
    str,
    Field(max_length=LONGEST_URL, examples=["https://hooks.studio.example/myoface"]),
    AfterValidator(_sendable),
]
Events = Annotated[
    list[EventType], Field(max_length=20, description="what it is told; empty: everything")
]
Kinds = Annotated[
    list[str],
    Field(max_length=20, description="only of jobs of these kinds; empty: all"),
    AfterValidator(_known),
]


class NewWebhook(RequestBody):
    """An address to tell what happens: `POST` with a Standard Webhooks signature."""

    url: Url
    events: Events = Field(default_factory=list)
    kinds: Kinds = Field(default_factory=list)


class WebhookChange(Change):
    """Changes of a webhook; the rest stays. `active: true` gives a failed one a new start."""

    url: Url | None = None
    events: Events | None = None
    kinds: Kinds | None = None
    active: bool | None = None


class WebhookView(View):
    """A webhook; `disabled_reason` is why it is off: `gone`, `failing`, `behind`, `by_user`."""

    id: str
    url: str
    events: list[str]
    kinds: list[str]
    active: bool
    disabled_reason: str | None
    failing_since: datetime | None
    rotated_at: datetime | None
    created_at: datetime


class WebhookWithSecret(WebhookView):
    """A webhook with the secret by which its receiver verifies signatures: told only now."""

    secret: str | None = Field(
        examples=["whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"],
        description="null: the request was a repetition of an answered one",
    )


class DeliveryView(View):
    """An event on its way, or what became of it; `error` is the code of what went wrong."""

    id: str
    webhook_id: str
    event_id: str
    type: str
    data: dict[str, Any]
    state: Literal["pending", "delivered", "failed"]
    attempt: int
    next_at: datetime | None
    status: int | None
    ms: int | None
    error: str | None
    excerpt: str | None
    created_at: datetime
    finished_at: datetime | None

    @classmethod
    def of(cls, delivery: Delivery) -> DeliveryView:
        """Show a delivery."""
        event = delivery.event
        of_row = {
            name: getattr(delivery, name)
            for name in cls.model_fields
            if name not in ("type", "data")
        }
        return cls(type=event.type, data=event.data, **of_row)
