"""A tenant's jobs run no more at a time than its quota, on both databases."""

from __future__ import annotations

import threading

import pytest
from sqlalchemy import select

from service.queue import table
from service.queue.claims import claim_next
from service.queue.states import HELD, State
from service.store.database import WAKE, Store
from service.store.models import Job, Tenant
from tests.integration.test_queue import ANYTHING, Shop, store  # noqa: F401 (a fixture)

pytestmark = pytest.mark.telling


def test_workers_at_a_time_keep_to_a_quota(store: Store) -> None:  # noqa: F811
    shop = Shop(store)
    shop.queue("A", *range(6))
    shop.queue("A", 9, queue="long")
    shop.queue("B", 7)
    with store.write() as session:
        session.get_one(Tenant, shop.subjects["A"][0]).max_running = 2
    taken: list[str] = []
    ready = threading.Barrier(6)

    def take() -> None:
        ready.wait()
        name = shop.take()
        if name:
            taken.append(name)

    threads = [threading.Thread(target=take) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(name.startswith("A") for name in taken) <= 2
    taken += shop.take_all()
    assert sorted(taken) == ["A0", "A1", "B7"]
    with store.write() as session:
        assert claim_next(session, "long", ANYTHING, 60) is None

    with store.write() as session:
        mine = select(Job).where(Job.tenant_id == shop.subjects["A"][0], Job.state.in_(HELD))
        held = session.scalars(mine).first()
        assert held
        assert table.succeed(session, held.id, held.attempt, [])
        woken = {queue for _, queue in session.info[WAKE]}
    assert woken == {"short", "long"}  # it may have been the quota that they waited for
    with store.write() as session:
        assert claim_next(session, "long", ANYTHING, 60) is not None
    assert shop.take() is None
    with store.read() as session:
        waiting = select(Job).where(Job.state == State.QUEUED, Job.queue == "short")
        assert len(session.scalars(waiting).all()) == 4
