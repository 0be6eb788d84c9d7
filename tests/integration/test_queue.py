"""Which job is next: fair between tenants, by priority within one, only what a worker can do."""

from __future__ import annotations

import threading
import time
import uuid
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert, select, update

from service.queue import sweep, table
from service.queue.claims import Abilities, claim_next, positions
from service.queue.states import State
from service.store.database import WAKE, Store, clock
from service.store.models import ApiKey, Attempt, Event, Job, Subject, Tenant, Worker, now
from tests.stores import open_store

pytestmark = pytest.mark.telling

ANYTHING = Abilities("w", frozenset({"build_model", "register_scan"}), memory_mb=8192, threads=1)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """A store whose tables have no job yet."""
    with open_store(tmp_path) as store:
        with store.write() as session:
            session.execute(Subject.__table__.delete())
        yield store


class Shop:
    """Tenants with one subject each, who queue jobs; job ``n`` is older than job ``n + 1``."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.begin = now() - timedelta(hours=1)
        self.subjects: dict[str, tuple[str, str]] = {}
        self.names: dict[str, str] = {}

    def queue(self, tenant: str, *numbers: int, **more: Any) -> None:
        with self.store.write() as session:
            if tenant not in self.subjects:
                session.add(owner := Tenant(name=tenant))
                session.flush()
                session.add(subject := Subject(tenant_id=owner.id, name="x"))
                session.flush()
                self.subjects[tenant] = (owner.id, subject.id)
            rows = [self._row(tenant, number, more) for number in numbers]
            session.execute(insert(Job), rows)
        pairs = zip(rows, numbers, strict=True)
        self.names |= {row["id"]: f"{tenant}{number}" for row, number in pairs}

    def _row(self, tenant: str, number: int, more: dict[str, Any]) -> dict[str, Any]:
        owner, subject = self.subjects[tenant]
        return {
            "id": str(uuid.uuid4()),
            "tenant_id": owner,
            "subject_id": subject,
            "kind": "build_model",
            "queue": "short",
            "request": {"options": {}, "rig_id": None},
            "inputs": [],
            "max_attempts": 3,
            "created_at": self.begin + timedelta(seconds=number),
            **more,
        }

    def keep(self, tenant: str, since: timedelta = timedelta(), scope: str = "write") -> None:
        """Let a tenant have sent a request."""
        owner, _ = self.subjects[tenant]
        with self.store.write() as session:
            key = ApiKey(name="x", hash="x", scopes=[scope], last_used_at=now() - since)
            key.id = uuid.uuid4().hex[:12]
            key.tenant_id = owner
            session.add(key)

    def take(self, who: Abilities = ANYTHING, lease: float = 60) -> str | None:
        with self.store.write() as session:
            claim = claim_next(session, "short", who, lease)
        return claim and self.names[claim.job_id]

    def take_all(self) -> list[str]:
        taken = []
        while (name := self.take()) is not None:
            taken.append(name)
        return taken

    def places(self) -> list[str]:
        """Return the names of the waiting jobs by their places."""
        with self.store.read() as session:
            waiting = session.scalars(select(Job).where(Job.queue == "short")).all()
            found = positions(session, waiting)
        assert sorted(found.values()) == list(range(1, len(found) + 1))
        return [self.names[job_id] for job_id, _ in sorted(found.items(), key=lambda item: item[1])]


def test_tenants_take_turns_and_priority_counts_within_one(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", *range(6), priority=9)
    shop.queue("b", 10, 11)
    shop.queue("b", 12, priority=1)
    shop.queue("c", 5, priority=-9)
    shop.queue("a", 20, queue="long")
    assert shop.take() == "a0"
    foreseen = shop.places()
    assert foreseen == ["c5", "b12", "a1", "b10", "a2", "b11", "a3", "a4", "a5"]
    # what the places say is what happens
    assert shop.take_all() == foreseen
    with store.read() as session:
        waiting = session.scalars(select(Job).where(Job.queue == "long")).all()
        assert list(positions(session, waiting).values()) == [1]


def test_a_tenant_sees_its_places_among_all(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0, 1, 2)
    shop.queue("b", 3)
    owner, _ = shop.subjects["b"]
    with store.of(owner).read() as session:
        own = session.scalars(select(Job)).all()
        assert list(positions(session, own).values()) == [2]


def test_a_worker_takes_only_what_it_can_do(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0, kind="from_the_next_release")
    shop.queue("a", 1, memory_mb=16_000)
    shop.queue("a", 2, not_before=now() + timedelta(minutes=4))
    shop.queue("a", 3, not_before=now() - timedelta(hours=1))
    shop.queue("a", 4, kind="register_scan", memory_mb=8192)
    only_models = Abilities("m", frozenset({"build_model"}), memory_mb=4096, threads=1)
    assert [shop.take(only_models), shop.take(only_models)] == ["a3", None]
    assert [shop.take(), shop.take()] == ["a4", None]
    large = Abilities("l", frozenset({"build_model"}), memory_mb=16_000, threads=1)
    assert shop.take(large) == "a1"
    with store.write() as session:
        sweep.resend(session, 10, at_once=True)
        woken = [shop.names[job_id] for job_id, _ in session.info.pop(WAKE)]
    assert woken == ["a0"]


def test_a_tenant_at_its_quota_is_passed_over(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0, 1, 2)
    shop.queue("b", 10)
    with store.write() as session:
        owner, _ = shop.subjects["a"]
        session.execute(update(Tenant).where(Tenant.id == owner).values(max_running=1))
    assert shop.take_all() == ["a0", "b10"]


def _add_workers(store: Store, *slots: int) -> None:
    with store.write() as session:
        for number, each in enumerate(slots):
            session.add(Worker(name=f"worker {number}", queue="short", slots=each))


@pytest.mark.parametrize(
    ("slots", "present", "taken"),
    [
        ((1, 1), {"b": {}}, ["a0"]),
        ((2, 2), {"b": {}}, ["a0", "a1", "a2"]),
        ((1, 1), {}, ["a0", "a1"]),
        ((1, 1), {"a": {}}, ["a0", "a1"]),
        ((1, 1), {"b": {"since": timedelta(hours=1)}}, ["a0", "a1"]),
        ((1, 1), {"b": {"scope": "metrics"}}, ["a0", "a1"]),
        ((1,), {"b": {}}, ["a0"]),
    ],
)
def test_the_last_free_worker_is_kept_for_a_tenant_that_may_need_it(
    store: Store, slots: tuple[int, ...], present: dict[str, Any], taken: list[str]
) -> None:
    shop = Shop(store)
    shop.queue("a", *range(9))
    shop.queue("b", 20, queue="long")
    _add_workers(store, *slots)
    for tenant, how in present.items():
        shop.keep(tenant, **how)
    assert [shop.take() for _ in range(len(taken))] == taken
    if len(taken) < sum(slots):
        assert shop.take() is None
        shop.queue("b", 10)
        assert shop.take() == "b10"


def test_no_worker_is_kept_from_those_who_all_have_one(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0, 1)
    shop.queue("b", 10, 11)
    _add_workers(store, 3)
    for tenant in "ab":
        shop.keep(tenant)
    assert [shop.take() for _ in range(3)] == ["a0", "b10", "a1"]


def test_workers_that_ask_at_once_keep_one_as_well(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", *range(9))
    shop.queue("b", 20, queue="long")
    _add_workers(store, 4)
    shop.keep("b")
    ready = threading.Barrier(4)

    def work(_number: int) -> str | None:
        ready.wait()
        return shop.take()

    with ThreadPoolExecutor(4) as workers:
        taken = list(workers.map(work, range(4)))
    assert sorted(filter(None, taken)) == ["a0", "a1", "a2"]


def test_a_job_whose_worker_is_silent_is_taken_again(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0)
    assert shop.take(lease=-1) == "a0"
    assert shop.take() == "a0"
    assert shop.take() is None


def test_eight_workers_take_each_job_once(store: Store) -> None:
    shop = Shop(store)
    for tenant in "abcd":
        shop.queue(tenant, *range(50))
    taken: list[str] = []
    ready = threading.Barrier(8)

    def work() -> None:
        ready.wait()
        taken.extend(shop.take_all())

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert Counter(taken) == dict.fromkeys(shop.names.values(), 1)
    with store.read() as session:
        assert set(session.scalars(select(Job.attempt))) == {1}


@pytest.mark.slow
def test_a_claim_among_twenty_thousand(store: Store) -> None:
    shop = Shop(store)
    for tenant in "abcd":
        shop.queue(tenant, *range(5000))
    began = time.perf_counter()
    taken = [shop.take() for _ in range(20)]
    claims = time.perf_counter() - began
    with store.read() as session:
        page = session.scalars(select(Job).where(Job.state == State.QUEUED).limit(100)).all()
        began = time.perf_counter()
        assert len(positions(session, page)) == 100
    places = time.perf_counter() - began
    kind = store.database.url.get_backend_name()
    figures = f"{kind}: {claims / 20 * 1e3:.1f} ms a claim, {places * 1e3:.1f} ms a page of places"
    print(figures)  # noqa: T201 (the figure is for whoever runs the test)
    for number in range(5):
        turn = taken[4 * number : 4 * number + 4]
        assert sorted(turn) == [f"{tenant}{number}" for tenant in "abcd"]


def test_a_full_disk_and_a_shutdown_cost_no_try(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0)
    (job_id,) = shop.names
    error = {"code": "storage.full", "message": "there is no room left for files"}

    def claimed() -> int:
        with store.write() as session:
            session.execute(update(Job).values(not_before=None))
            claim = claim_next(session, "short", ANYTHING, 60)
        assert claim
        return claim.attempt

    def job() -> Job:
        with store.read() as session:
            return session.get_one(Job, job_id)

    for _ in range(4):
        attempt = claimed()
        with store.write() as session:
            table.postpone(session, job_id, attempt, error)
        assert shop.take() is None
        attempt = claimed()
        with store.write() as session:
            assert table.release(session, job_id, attempt)
    assert (job().lost, job().max_attempts, job().attempt) == (0, 3, 8)
    for lost in (1, 2):
        attempt = claimed()
        with store.write() as session:
            table.lose(session, job_id, attempt, error)
        assert (job().state, job().lost, job().no_room_since) == (State.QUEUED, lost, None)
    attempt = claimed()
    with store.write() as session:
        long_ago = clock(session) - timedelta(hours=2)
        session.execute(update(Job).values(no_room_since=long_ago))
        table.postpone(session, job_id, attempt, error)
    assert (job().state, job().error) == (State.FAILED, error)
    with store.read() as session:
        outcomes = session.scalars(select(Attempt.outcome).order_by(Attempt.number)).all()
    assert outcomes == [*["postponed", "released"] * 4, "lost", "lost", "failed"]


def test_of_a_finished_job_some_reports_are_kept(store: Store) -> None:
    shop = Shop(store)
    shop.queue("a", 0, 1)
    for count in (150, 1500):
        with store.write() as session:
            claim = claim_next(session, "short", ANYTHING, 60)
            assert claim
            steps = [{"phase": "x", "fraction": 0.1, "iteration": n} for n in range(count)]
            for first in range(0, count, 50):
                some = steps[first : first + 50]
                table.beat(session, claim.job_id, claim.attempt, 60, steps=some)
        with store.write() as session:
            assert table.succeed(session, claim.job_id, claim.attempt, [])
        with store.read() as session:
            mine = select(Event).where(Event.job_id == claim.job_id).order_by(Event.id)
            events = session.scalars(mine).all()
        reports = [event.data["iteration"] for event in events if event.kind == "progress"]
        assert len(reports) == min(count, 188)
        assert max(reports) == count - 1
        assert [e.data["state"] for e in events if e.kind == "state"] == ["running", "succeeded"]
