"""What Prometheus is told, read by its own parser."""

from __future__ import annotations

import math
from datetime import timedelta
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families as parse
from sqlalchemy import update

from service.queue import sweep, table
from service.settings import Settings
from service.store.models import Attempt, Job, now
from service.system import metrics
from solver.kinds import KINDS
from tests.service_client import Studio, served

Samples = dict[tuple[str, ...], float]


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "KEPT", 0)


def _read(studio: Studio) -> dict[str, Samples]:
    answer = studio.http.get("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    found: dict[str, Samples] = {}
    for family in parse(answer.text):
        assert family.documentation
        for sample in family.samples:
            key = tuple(sample.labels[label] for label in sorted(sample.labels))
            found.setdefault(sample.name, {})[key] = sample.value
    return found


def test_queues_and_what_is_stuck(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        empty = _read(studio)
        assert empty["myoface_jobs"]["short", "queued"] == 0
        assert empty["myoface_part_ready"]["database",] == 1
        assert empty["myoface_workers"]["long",] == 0
        assert empty["myoface_deliveries_pending"][()] == 0
        subject = studio.subject()
        job_id = studio.submit("build_model", subject)
        busy = _read(studio)
        assert busy["myoface_jobs"]["short", "queued"] == 1
        assert 0 <= busy["myoface_oldest_queued_seconds"]["short",] < 60
        assert busy["myoface_stored_bytes"]["scans",] > 0
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        with store.write() as session:
            values = {"state": "running", "lease_until": now().replace(year=2020)}
            session.execute(update(Job).where(Job.id == job_id).values(**values))
        stuck = _read(studio)
        assert stuck["myoface_leases_expired"][()] == 1
        studio.post(f"/v1/jobs/{job_id}/cancel", reason="enough")
        assert 0 <= _read(studio)["myoface_canceling_oldest_seconds"][()] < 60


def test_jobs_that_take_longer_than_usual(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        subject = studio.subject()

        def overdue() -> float:
            return _read(studio)["myoface_jobs_overdue"]["build_model",]

        def started(job_id: str, seconds: float) -> None:
            with store.write() as session:
                begun = {"started_at": now() - timedelta(seconds=seconds)}
                session.execute(update(Attempt).where(Attempt.job_id == job_id).values(begun))

        assert overdue() == 0
        job_id = studio.submit("build_model", subject)
        with store.write() as session:
            assert table.take(session, job_id, "test", 1e6)
        limit = KINDS["build_model"].max_seconds
        for seconds, found in ((limit / 2 - 60, 0), (limit / 2 + 60, 1)):  # few are known
            started(job_id, seconds)
            assert overdue() == found
        for _ in range(metrics.LEAST_KNOWN):
            done = studio.submit("build_model", subject)
            studio.pretend(done, {"model.npz": "0" * 64})
            started(done, 100)
        for seconds, found in ((150, 0), (250, 1)):  # twice what those took
            started(job_id, seconds)
            assert overdue() == found
        with store.write() as session:
            assert table.fail(session, job_id, 1, {"code": "x", "message": "x"})
        assert overdue() == 0


def test_a_sweeper_that_never_came_is_told(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        assert _read(studio)["myoface_sweeper_last_round_seconds"][()] == math.inf
        with store.write() as session:
            assert sweep.hold_office(session, sweep.SWEEPER, "w", 15)
        assert 0 <= _read(studio)["myoface_sweeper_last_round_seconds"][()] < 60


def test_how_long_jobs_and_answers_take(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        studio.pretend(studio.submit("build_model", subject), {"model.npz": "0" * 64})
        for path in (f"/v1/subjects/{subject}", "/v1/subjects/nobody", "/no/such/page"):
            studio.http.get(path)
        found = _read(studio)
        assert found["myoface_jobs_ended"]["build_model", "succeeded"] == 1
        assert found["myoface_job_seconds"]["build_model", "succeeded", "0.95"] >= 0
        assert found["myoface_queue_wait_seconds"]["0.5", "short"] >= 0
        counts = found["http_request_seconds_count"]
        assert counts["GET", "/v1/subjects/{subject_id}", "200"] == 1
        assert counts["GET", "/v1/subjects/{subject_id}", "422"] == 1
        assert not [key for key in counts if subject in key[1] or "such" in key[1]]
