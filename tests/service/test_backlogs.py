"""A tenant's backlog costs others nothing: what is read does not grow with it.

Counted are the steps of SQLite's virtual machine, not seconds.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, insert, select
from sqlalchemy.orm import Session

from service.queue import claims, outbox
from service.queue.claims import Abilities, claim_next, positions
from service.store.database import Store, clock
from service.store.models import Delivery, Job, Subject, Tenant, Webhook, WebhookEvent, now
from tests.stores import open_store

FEW = 200
MANY = 3000
BEGIN = now() - timedelta(hours=1)
ANYBODY = Abilities("w", frozenset({"build_model"}), memory_mb=8192, threads=1)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    both = ("large", "small")
    with open_store(tmp_path) as store:
        with store.write() as session:
            session.add_all(Tenant(id=name, name=name) for name in both)
            session.flush()
            session.add_all(Subject(id=name, tenant_id=name, name=name) for name in both)
            session.add_all(
                Webhook(id=name, tenant_id=name, url="https://x.example", events=[], kinds=[])
                for name in both
            )
        yield store


def _queue(store: Store, tenant: str, count: int) -> None:
    rows = [
        {
            "id": str(uuid.uuid4()),
            "tenant_id": tenant,
            "subject_id": tenant,
            "kind": "build_model",
            "queue": "short",
            "request": {"options": {}, "rig_id": None},
            "inputs": [],
            "max_attempts": 3,
            "created_at": BEGIN + timedelta(seconds=number),
        }
        for number in range(count)
    ]
    with store.write() as session:
        session.execute(insert(Job), rows)


def _announce(store: Store, tenant: str, count: int) -> None:
    event_id = str(uuid.uuid4())
    rows = [
        {
            "id": str(uuid.uuid4()),
            "tenant_id": tenant,
            "webhook_id": tenant,
            "event_id": event_id,
            "created_at": BEGIN,
            "next_at": BEGIN + timedelta(seconds=number),
        }
        for number in range(count)
    ]
    with store.write() as session:
        session.add(WebhookEvent(id=event_id, tenant_id=tenant, type="job.failed", data={}))
        session.flush()
        session.execute(insert(Delivery), rows)


def _steps(session: Session, do: Callable[[Session], Any]) -> int:
    """Return the steps of the virtual machine that something takes, in tens."""
    session.scalar(select(func.count()).select_from(Tenant))  # the transaction has begun
    driver: Any = session.connection().connection.driver_connection
    count = 0

    def note() -> int:
        nonlocal count
        count += 1
        return 0

    driver.set_progress_handler(note, 10)
    try:
        do(session)
    finally:
        driver.set_progress_handler(None, 0)
    return count


def _claim(session: Session) -> None:
    assert claim_next(session, "short", ANYBODY, 60)


def _take(session: Session) -> None:
    taken = outbox.take(session, [], 8, 60)
    assert {claimed.tenant_id for claimed in taken} == {"large", "small"}


def _is_due(session: Session) -> None:
    assert outbox.is_due(session)


@pytest.mark.long
@pytest.mark.parametrize("do", [_claim, _take, _is_due], ids=["claim", "take", "is_due"])
def test_a_look_reads_as_much_of_a_long_queue_as_of_a_short_one(
    store: Store, do: Callable[[Session], Any]
) -> None:
    counts = []
    for count in (FEW, MANY - FEW):
        for tenant in ("large", "small"):
            _queue(store, tenant, count if tenant == "large" else 1)
            _announce(store, tenant, count if tenant == "large" else 1)
        with store.write() as session:
            counts.append(_steps(session, do))
            session.rollback()
    assert counts[1] < 1.5 * counts[0], counts


@pytest.mark.long
def test_a_place_costs_what_comes_before_it(store: Store) -> None:
    _queue(store, "small", 2)
    counts = []
    for count in (FEW, MANY - FEW):
        _queue(store, "large", count)
        with store.of("small").read() as session:
            own = session.scalars(select(Job).order_by(Job.created_at)).all()
            counts.append(_steps(session, lambda session, own=own: positions(session, own)))
    assert counts[1] < 1.5 * counts[0], counts


@pytest.mark.long
def test_a_place_is_told_when_it_is_near(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "MOST_TURNS", 5)
    _queue(store, "large", 20)
    _queue(store, "small", 2)
    with store.read() as session:
        jobs = session.scalars(select(Job).order_by(Job.tenant_id, Job.created_at)).all()
        found = positions(session, jobs)
    assert sorted(found.values()) == list(range(1, 8))
    assert [found.get(job.id) is None for job in jobs] == [*[False] * 5, *[True] * 15, *[False] * 2]


def test_a_job_put_off_before_the_clock_was_set_back_has_a_place(store: Store) -> None:
    _queue(store, "small", 2)
    with store.write() as session:
        jobs = session.scalars(select(Job).order_by(Job.created_at)).all()
        jobs[0].not_before = clock(session) + timedelta(minutes=1)  # put off
        jobs[1].not_before = clock(session) + timedelta(hours=1)  # for longer than anybody is
        session.flush()
        assert positions(session, jobs) == {jobs[1].id: 1}
