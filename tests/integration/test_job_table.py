"""The job table's rules on a database, where several workers are at it at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.queue import sweep, table
from service.queue.claims import Abilities, claim_next
from service.queue.states import State
from service.queue.table import Claim
from service.settings import Settings
from service.store import retention
from service.store.database import Store, clock
from service.store.models import DEFAULT_TENANT, Event, Job, Lease, Subject, Tenant
from tests.service_client import running, served
from tests.stores import open_store

pytestmark = pytest.mark.telling


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as store:
        yield store


def test_a_job_is_claimed_by_one_of_many(store: Store) -> None:
    _queue(store)
    claims: list[Claim | None] = []
    ready = threading.Barrier(8)

    def claim(number: int) -> None:
        ready.wait()
        with store.write() as session:
            claims.append(_claim(session, f"worker {number}", 30))

    threads = [threading.Thread(target=claim, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.attempt for one in claims if one] == [1]


def test_an_office_held_far_into_the_future_is_free(store: Store) -> None:
    with store.write() as session:
        assert sweep.hold_office(session, "sweeper", "dead", 15)
    with store.write() as session:
        assert not sweep.hold_office(session, "sweeper", "other", 15)
        lease = session.get_one(Lease, "sweeper")
        lease.until = clock(session) + timedelta(hours=1)  # the clock was set back by an hour
    with store.write() as session:
        assert sweep.hold_office(session, "sweeper", "other", 15)
        assert session.get_one(Lease, "sweeper").until < clock(session) + timedelta(seconds=16)
    with store.write() as session:
        assert not sweep.hold_office(session, "sweeper", "dead", 15)


def test_a_clock_that_is_set_back_holds_up_no_job(store: Store) -> None:
    job_id = _queue(store)
    with store.write() as session:
        claim = _claim(session, "dead", 30)
        assert claim
        job = session.get_one(Job, job_id)
        ahead = timedelta(minutes=8)
        assert job.leased_at
        assert job.lease_until
        job.leased_at = job.leased_at + ahead
        job.lease_until = job.lease_until + ahead
    with store.write() as session:
        sweep.expire_leases(session)
        job = session.get_one(Job, job_id)
        assert (job.state, job.lost) == (State.QUEUED, 1)
        job.sent_at = clock(session) + timedelta(hours=1)
        job.sends = 1
    with store.write() as session:
        sweep.resend(session, 10)
        assert session.get_one(Job, job_id).sends == 2
        session.get_one(Job, job_id).not_before = clock(session) + timedelta(hours=1)
    with store.write() as session:
        claim = _claim(session, "other", 30)
        assert claim
        assert claim.attempt == 2
    with store.write() as session:
        sweep.expire_leases(session)  # of who holds it now
        assert session.get_one(Job, job_id).state is State.RUNNING


def test_a_long_queue_keeps_no_other_from_being_sent_again(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "MOST_SENT", 2)
    queued = [_queue(store) for _ in range(4)]
    with store.write() as session:
        other = session.get_one(Job, queued[-1])
        other.queue = "long" if other.queue == "short" else "short"
        jobs = [session.get_one(Job, job_id) for job_id in queued]
        before = [job.sends for job in jobs]
        sweep.resend(session, 10, at_once=True)
        more = [job.sends - times for job, times in zip(jobs, before, strict=True)]
    assert more[-1] == 1
    assert sorted(more[:3]) == [0, 1, 1]


def test_a_longer_lease_of_another_host_s_is_no_clock_set_back(store: Store) -> None:
    job_id = _queue(store)
    with store.write() as session:
        assert _claim(session, "other host", 1200)
        sweep.expire_leases(session)
        assert session.get_one(Job, job_id).state is State.RUNNING


def test_thinning_keeps_the_newest_report(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "MOST_STEPS", 10)
    job_id = _queue(store)
    with store.write() as session:
        claim = _claim(session, "w", 30)
        assert claim
        steps = [{"phase": str(number), "fraction": 0.5} for number in range(11)]
        table.beat(session, job_id, claim.attempt, 30, steps=steps)
        reports = select(Event).where(Event.job_id == job_id, Event.kind == "progress")
        kept = [each.data["phase"] for each in session.scalars(reports.order_by(Event.id))]
    assert kept == ["1", "4", "7", "10"]


def test_a_lost_attempt_is_fenced_off(store: Store) -> None:
    job_id = _queue(store)
    with store.write() as session:
        first = _claim(session, "slow", 0.01)
    time.sleep(0.05)
    with store.write() as session:
        sweep.expire_leases(session)
    with store.write() as session:
        second = _claim(session, "quick", 30)
    assert first
    assert second
    with store.write() as session:
        assert table.beat(session, job_id, first.attempt, 30) is None
        assert not table.succeed(session, job_id, first.attempt, [])
        assert table.succeed(session, job_id, second.attempt, [])
    with store.read() as session:
        job = session.get(Job, job_id)
        assert job
        assert job.state is State.SUCCEEDED
        assert abs(clock(session) - job.created_at) < timedelta(minutes=1)


@pytest.mark.slow
def test_a_session_from_scans_to_deletion(tmp_path: Path) -> None:
    with running(tmp_path) as (_, studio):
        subject = studio.post("/v1/subjects", name="Alex")["id"]
        neutral = studio.raw(subject, "neutral", "neutral")
        smile = studio.raw(subject, "smile")
        for capture in (neutral, smile):
            studio.done("check_scan", subject, captures=[capture])
            studio.done("register_scan", subject, captures=[capture])
        studio.done("build_model", subject)
        studio.done("fit_geometry", subject, captures=[smile])
        first = studio.get(f"/v1/jobs?subject_id={subject}&limit=4")
        rest = studio.get(f"/v1/jobs?subject_id={subject}&limit=4&cursor={first['next']}")
        assert [len(first["items"]), len(rest["items"]), rest["next"]] == [4, 2, None]
        shown = studio.get(f"/v1/subjects/{subject}/captures")["items"]
        assert [each["check"]["verdict"] for each in shown] == ["good", "good"]
        assert studio.http.delete(f"/v1/subjects/{subject}/captures/{smile}").status_code == 204
        assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 204
        assert studio.get(f"/v1/jobs?subject_id={subject}")["items"] == []


def test_requests_that_cross_wait_for_one_another(store: Store, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with store.write() as session:
        session.get_one(Tenant, DEFAULT_TENANT).max_queued = 2
    with served(settings) as studio:
        subject = studio.subject()
        body = {"kind": "build_model", "subject_id": subject}
        answers: list[tuple[int, str]] = []
        ready = threading.Barrier(8)

        def submit(number: int) -> None:
            ready.wait()
            headers = {"Idempotency-Key": f"job {number % 4}".replace(" ", "-")}
            answer = studio.http.post("/v1/jobs", json=body, headers=headers)
            answers.append((answer.status_code, answer.json().get("code", "")))

        threads = [threading.Thread(target=submit, args=(number,)) for number in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        refused = {(409, "idempotency.in_flight"), (429, "quota.queued")}
        assert set(answers) <= {(201, ""), *refused}, answers
        assert len(studio.get(f"/v1/jobs?subject_id={subject}")["items"]) == 2
        assert studio.get("/v1/usage")["queued"] == {"used": 2, "limit": 2}
        receipt = studio.http.delete(f"/v1/subjects/{subject}?cancel=true").headers["Location"]
        retention.enforce(store, settings.model_copy(update={"retain_jobs": 1, "retain_rigs": 1}))
        assert studio.get(receipt)["rows_at"] is not None
        assert studio.get("/v1/audit")["items"][0]["action"] == "subject.deleted"


def _claim(session: Session, worker: str, lease: float) -> Claim | None:
    who = Abilities(worker, frozenset({"build_model"}), memory_mb=8192, threads=1)
    return claim_next(session, "short", who, lease)


def _queue(store: Store) -> str:
    with store.write() as session:
        subject = Subject(tenant_id=DEFAULT_TENANT, name="Alex")
        session.add(subject)
        session.flush()
        job = Job(
            tenant_id=DEFAULT_TENANT,
            subject_id=subject.id,
            kind="build_model",
            queue="short",
            request={"options": {}, "rig_id": None},
            inputs=[],
            max_attempts=3,
        )
        table.create(session, job)
        return job.id
