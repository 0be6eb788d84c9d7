"""The outbox: webhook events are written in the transaction of what happened.

So nothing is announced that did not happen, and nothing that happened is forgotten. Deliveries are
a queue of their own: a worker takes some for the time of a lease, and one that died loses them.
"""

from __future__ import annotations

import uuid
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, delete, func, literal, or_, select, union_all, update
from sqlalchemy.orm import Session

from service.queue.states import FINAL, State
from service.store.database import clock
from service.store.models import Delivery, Job, Webhook, WebhookEvent

TEST = "webhook.test"
CHECK = "check_scan"

PENDING = "pending"
DELIVERED = "delivered"
FAILED = "failed"
OLD_SECRET_COUNTS = timedelta(days=1)
GIVE_UP_AFTER = timedelta(days=5)
FORGET_AFTER = timedelta(days=30)
AT_ONCE_PER_WEBHOOK = 2
# Longest `Retry-After` that a receiver is granted
LONGEST_WISH = timedelta(days=1)
GONE = 410
# Deliveries that may wait for a webhook that fails
MOST_PENDING = 10_000


@dataclass(frozen=True)
class ClaimedDelivery:
    """A delivery as a worker holds it; ``attempt`` is the fence."""

    delivery_id: str
    attempt: int
    tenant_id: str
    webhook_id: str
    url: str
    generations: Sequence[int]
    """Whose secrets sign: the present one, and the one before while receivers change over."""
    failing: bool
    event_id: str
    type: str
    data: dict[str, Any]
    created_at: datetime


@dataclass(frozen=True)
class DeliveryOutcome:
    """Outcome of a try: the answer's status, or the code of an error.

    ``retry_after`` are the seconds for which the receiver wants to be left alone.
    """

    status: int | None = None
    ms: int | None = None
    error: str | None = None
    excerpt: str | None = None
    retry_after: float = 0.0

    @property
    def is_delivered(self) -> bool:
        """Return whether the receiver took it."""
        return self.status is not None and 200 <= self.status < 300


def notify(
    session: Session, tenant_id: str, type: str, data: dict[str, Any], kind: str | None = None
) -> None:
    """Queue an event for the tenant's webhooks that subscribe to it.

    ``data`` holds ids and states, never names; ``kind`` is the kind of the job it is about.
    """
    hooks = session.scalars(
        select(Webhook).where(Webhook.tenant_id == tenant_id, Webhook.active)
    ).all()
    asking = [hook for hook in hooks if _asks(hook, type, kind) and _keeps_up(session, hook)]
    if asking:
        send(session, asking, type, data)


def notify_of_job(session: Session, job: Job) -> None:
    """Announce that a job has begun or is over, and that a scan has been checked."""
    if job.state not in (State.RUNNING, *FINAL):
        return
    data: dict[str, Any] = {
        "job_id": job.id,
        "kind": job.kind,
        "subject_id": job.subject_id,
        "capture_id": job.capture_id,
        "state": job.state.value,
        "attempt": job.attempt,
    }
    if job.error:
        data["error"] = job.error["code"]
    event = "started" if job.state is State.RUNNING else job.state.value
    notify(session, job.tenant_id, f"job.{event}", data, job.kind)
    if job.kind == CHECK and job.state is State.SUCCEEDED:
        checked = {key: data[key] for key in ("job_id", "subject_id", "capture_id")}
        verdict = (job.summary or {}).get("verdict")
        notify(session, job.tenant_id, "scan.checked", {**checked, "verdict": verdict}, job.kind)


def send(
    session: Session, hooks: Sequence[Webhook], type: str, data: dict[str, Any]
) -> list[Delivery]:
    """Put an event for ``hooks``, all of one tenant, into the outbox."""
    moment = clock(session)
    event = WebhookEvent(
        id=f"msg_{uuid.uuid4().hex}",
        tenant_id=hooks[0].tenant_id,
        type=type,
        data=data,
        created_at=moment,
    )
    session.add(event)
    session.flush()
    return [send_again(session, hook.id, event, moment) for hook in hooks]


def send_again(
    session: Session, webhook_id: str, event: WebhookEvent, moment: datetime
) -> Delivery:
    """Put an event into the outbox for one webhook, whoever has had it before."""
    delivery = Delivery(
        tenant_id=event.tenant_id,
        webhook_id=webhook_id,
        event_id=event.id,
        created_at=moment,
        next_at=moment,
    )
    session.add(delivery)
    session.flush()
    return delivery


def is_due(session: Session) -> bool:
    """Return whether there is something to send."""
    return session.execute(_due(clock(session)).limit(1)).first() is not None


def take(
    session: Session, under_way: Collection[ClaimedDelivery], threads: int, lease: float
) -> list[ClaimedDelivery]:
    """Take deliveries that are due, for those of a worker's ``threads`` that are free.

    The tenants take turns, the one with least under way here first. Beyond half of the threads, a
    tenant gets only those that nobody else has a use for. A webhook gets
    few at once, one that fails gets one, and those that fail get half of the threads together: a
    receiver that does not answer holds up nobody else's news.
    """
    moment = clock(session)
    half = max(threads // 2, 1)
    held = Counter((claimed.tenant_id, claimed.failing) for claimed in under_way)

    def turn(row: Any) -> int:
        of_tenant: int = row.turn + held[row.tenant_id, row.is_failing]
        return of_tenant

    rows = sorted(session.execute(_due(moment)).all(), key=turn)
    working = [row for row in rows if not row.is_failing]
    failing = [row for row in rows if row.is_failing and row.place == 1]
    spare = max(half - sum(claimed.failing for claimed in under_way), 0)
    chosen = [
        *(row for row in working if turn(row) <= half),
        *failing[:spare],
        *(row for row in working if turn(row) > half),
    ][: threads - len(under_way)]
    until = moment + timedelta(seconds=lease)
    return [claimed for row in chosen if (claimed := _claim(session, row, moment, until))]


def settle(
    session: Session, claimed: ClaimedDelivery, outcome: DeliveryOutcome, pauses: Sequence[float]
) -> None:
    """Write down what became of a try; ``pauses`` are the seconds before each further one.

    A receiver that wants to be left alone is sent nothing of what waits for it.
    """
    moment = clock(session)
    hook = session.get(Webhook, claimed.webhook_id, with_for_update=True)
    if hook is None:
        return  # it was deleted, with its deliveries
    wish = min(timedelta(seconds=outcome.retry_after), LONGEST_WISH)
    values: dict[str, Any] = {
        "status": outcome.status,
        "ms": outcome.ms,
        "error": outcome.error,
        "excerpt": outcome.excerpt,
        "lease_until": None,
    }
    if outcome.is_delivered:
        values |= {"state": DELIVERED, "finished_at": moment, "next_at": None}
    elif claimed.attempt <= len(pauses):
        pause = timedelta(seconds=pauses[claimed.attempt - 1])
        values["next_at"] = moment + max(pause, wish)
    else:
        values |= {"state": FAILED, "finished_at": moment, "next_at": None}
    mine = session.execute(
        update(Delivery)
        .where(
            Delivery.id == claimed.delivery_id,
            Delivery.attempt == claimed.attempt,
            Delivery.state == PENDING,
        )
        .values(**values)
        .returning(Delivery.id)
    ).scalar_one_or_none()
    if mine is not None:
        _judge(session, hook, outcome, moment)
        if wish:
            _put_off(session, hook.id, moment + wish)


def switch_off(session: Session, webhook_id: str, reason: str, moment: datetime) -> None:
    """Disable a webhook; pending deliveries have failed."""
    session.execute(
        update(Webhook).where(Webhook.id == webhook_id).values(active=False, disabled_reason=reason)
    )
    session.execute(
        update(Delivery)
        .where(Delivery.webhook_id == webhook_id, Delivery.state == PENDING)
        .values(state=FAILED, finished_at=moment, next_at=None, lease_until=None)
    )


def forget(session: Session) -> None:
    """Delete old events with their log."""
    session.execute(
        delete(WebhookEvent).where(WebhookEvent.created_at < clock(session) - FORGET_AFTER)
    )


def _asks(hook: Webhook, type: str, kind: str | None) -> bool:
    of_events = not hook.events or type in hook.events
    return of_events and (not hook.kinds or kind is None or kind in hook.kinds)


def _keeps_up(session: Session, hook: Webhook) -> bool:
    """Return whether a webhook may be sent more; one that is too far behind is switched off."""
    if hook.failing_since is None:
        return True
    pending = select(Delivery.id).where(Delivery.webhook_id == hook.id, Delivery.state == PENDING)
    if session.execute(pending.offset(MOST_PENDING - 1).limit(1)).first() is None:
        return True
    switch_off(session, hook.id, "behind", clock(session))
    return False


def _due(moment: datetime) -> Any:
    """Return a query for what may be sent now, with its place at its webhook and in its tenant.

    The place counts what is under way to the webhook, by whichever worker. In a tenant its webhooks
    take turns, the oldest first; webhooks that fail have turns of their own.
    """
    is_failing = Webhook.failing_since.is_not(None)
    at_webhook = (
        select(Delivery.webhook_id, func.count().label("count"))
        .where(Delivery.state == PENDING, Delivery.lease_until > moment)
        .group_by(Delivery.webhook_id)
        .subquery()
    )
    first = union_all(*(_waiting(moment, number) for number in range(AT_ONCE_PER_WEBHOOK)))
    waiting = first.subquery()
    due = (
        select(
            Delivery.id,
            Delivery.tenant_id,
            Delivery.attempt,
            Delivery.next_at,
            is_failing.label("is_failing"),
            (waiting.c.number + func.coalesce(at_webhook.c.count, 0)).label("place"),
        )
        .select_from(waiting)
        .join(Delivery, Delivery.id == waiting.c.delivery_id)
        .join(Webhook, Webhook.id == Delivery.webhook_id)
        .outerjoin(at_webhook, at_webhook.c.webhook_id == Delivery.webhook_id)
        .subquery()
    )
    turn = func.row_number().over(
        partition_by=(due.c.tenant_id, due.c.is_failing),
        order_by=(due.c.place, due.c.next_at, due.c.id),
    )
    return (
        select(due, turn.label("turn"))
        .where(due.c.place <= AT_ONCE_PER_WEBHOOK)
        .order_by("turn", due.c.next_at, due.c.id)
    )


def _waiting(moment: datetime, before: int) -> Any:
    """Return a query for each webhook's delivery that may be sent after ``before`` others.

    Such a look reads a few rows of a webhook, however many wait for it.
    """
    delivery_id = (
        select(Delivery.id)
        .where(Delivery.webhook_id == Webhook.id, *_free(moment))
        .order_by(Delivery.next_at, Delivery.id)
        .limit(1)
        .offset(before)
        .correlate(Webhook)
        .scalar_subquery()
    )
    return select(
        literal(before + 1).label("number"), delivery_id.label("delivery_id")
    ).select_from(Webhook)


def _free(moment: datetime) -> Iterable[ColumnElement[bool]]:
    return (
        Delivery.state == PENDING,
        Delivery.next_at <= moment,
        or_(Delivery.lease_until.is_(None), Delivery.lease_until <= moment),
    )


def _claim(session: Session, row: Any, moment: datetime, until: datetime) -> ClaimedDelivery | None:
    attempt: int | None = session.execute(
        update(Delivery)
        .where(Delivery.id == row.id, Delivery.attempt == row.attempt, *_free(moment))
        .values(attempt=Delivery.attempt + 1, lease_until=until)
        .returning(Delivery.attempt)
    ).scalar_one_or_none()
    if attempt is None:
        return None  # another worker was faster
    delivery = session.get_one(Delivery, row.id)
    hook = session.get_one(Webhook, delivery.webhook_id)
    event = delivery.event
    generations = [hook.generation]
    if hook.rotated_at is not None and moment < hook.rotated_at + OLD_SECRET_COUNTS:
        generations.append(hook.generation - 1)
    return ClaimedDelivery(
        delivery_id=row.id,
        attempt=attempt,
        tenant_id=delivery.tenant_id,
        webhook_id=hook.id,
        url=hook.url,
        generations=generations,
        failing=hook.failing_since is not None,
        event_id=event.id,
        type=event.type,
        data=event.data,
        created_at=event.created_at,
    )


def _put_off(session: Session, webhook_id: str, until: datetime) -> None:
    """Send nothing of what waits for a webhook before ``until``."""
    waiting = (
        select(Delivery.id)
        .where(
            Delivery.webhook_id == webhook_id, Delivery.state == PENDING, Delivery.next_at < until
        )
        .with_for_update(skip_locked=True)  # of which one is just taken, it is under way
    )
    session.execute(update(Delivery).where(Delivery.id.in_(waiting)).values(next_at=until))


def _judge(session: Session, hook: Webhook, outcome: DeliveryOutcome, moment: datetime) -> None:
    """Note whether a webhook works; switch off one that is gone, or has failed for days."""
    if outcome.is_delivered:
        hook.failing_since = None
    elif outcome.status == GONE:
        switch_off(session, hook.id, "gone", moment)
    elif hook.failing_since is None:
        hook.failing_since = moment
    elif moment - hook.failing_since > GIVE_UP_AFTER:
        switch_off(session, hook.id, "failing", moment)
