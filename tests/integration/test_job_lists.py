"""Jobs made again, found again and read from their end; what watchers and workers are told."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from service.jobs import following
from service.queue import table
from service.settings import Settings
from service.store.models import ApiKey, Event, LogLine, now
from tests.service_client import Studio, served
from worker.abilities import abilities, show_life
from worker.process import MOST_LINES_KEPT, SolverProcess


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def test_a_job_is_made_again_with_other_options(studio: Studio) -> None:
    subject = studio.subject()
    options = {"edge_mm": 6.0}
    first = studio.submit("build_model", subject, options=options, priority=3, memory_mb=512)
    early = studio.http.post(f"/v1/jobs/{first}/retry")
    assert (early.status_code, early.json()["code"]) == (409, "job.not_over")
    studio.post(f"/v1/jobs/{first}/cancel", reason="the wrong edge length")
    key = {"Idempotency-Key": "once-more"}
    answers = [studio.http.post(f"/v1/jobs/{first}/retry", headers=key) for _ in range(2)]
    again, repeated = (answer.json() for answer in answers)
    assert again["id"] == repeated["id"]
    assert again["parent_id"] == first
    for member in ("kind", "subject_id", "options", "priority", "memory_mb"):
        assert again[member] == studio.job(first)[member]
    studio.post(f"/v1/jobs/{again['id']}/cancel")
    other = studio.post(f"/v1/jobs/{again['id']}/retry", options={"edge_mm": 12.0}, priority=-9)
    assert (other["options"], other["priority"]) == ({"edge_mm": 12.0}, -9)
    refused = studio.http.post(f"/v1/jobs/{first}/retry", json={"options": {"edge": 1}})
    assert (refused.status_code, refused.json()["code"]) == (422, "job.options")
    refused = studio.http.post(f"/v1/jobs/{first}/retry", json={"priority": 10})
    assert (refused.status_code, refused.json()["code"]) == (422, "request.invalid")
    found = studio.get(f"/v1/jobs?parent_id={first}")["items"]
    assert [job["id"] for job in found] == [again["id"]]


def test_lists_are_filtered_by_states_and_time(studio: Studio) -> None:
    subject = studio.subject()
    canceled, failed, queued = (studio.submit("build_model", subject) for _ in range(3))
    studio.post(f"/v1/jobs/{canceled}/cancel")
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.write() as session:
        claim = table.take(session, failed, "w", 60)
        assert claim
        table.fail(session, failed, claim.attempt, {"code": "x", "message": "x"})

    def found(query: str) -> set[str]:
        return {job["id"] for job in studio.get(f"/v1/jobs?{query}")["items"]}

    assert found("state=queued") == {queued}
    assert found("state=failed&state=canceled") == {failed, canceled}
    soon = (now() + timedelta(minutes=1)).isoformat().replace("+00:00", "Z")
    assert found(f"until={soon}&kind=build_model") == {canceled, failed, queued}
    assert found(f"since={soon}") == set()
    for wrong in ("since=yesterday", "since=2026-01-01T00:00:00", "since=0001-01-01T00:00:00%2B14"):
        assert studio.http.get(f"/v1/jobs?{wrong}").status_code == 422
    assert studio.job(queued)["queue_position"] == 1


def test_a_logs_end_can_be_read(studio: Studio) -> None:
    job = studio.submit("build_model", studio.subject())
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.write() as session:
        for number in range(1, 8):
            session.add(LogLine(job_id=job, number=number, attempt=1, text=f"line {number}"))

    def numbers(query: str) -> list[int]:
        return [line["number"] for line in studio.get(f"/v1/jobs/{job}/log?{query}")["lines"]]

    assert numbers("tail=2") == [6, 7]
    assert numbers("tail=5&after=4") == [5, 6, 7]
    assert numbers("limit=2") == [1, 2]


def test_watchers_of_many_jobs_are_all_told(studio: Studio) -> None:
    subject = studio.subject()
    watched = [studio.submit("build_model", subject) for _ in range(3)]
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.write() as session:
        for count in range(1200):
            session.add(Event(job_id=watched[0], kind="progress", data={"n": count}))
    for job in watched:
        studio.post(f"/v1/jobs/{job}/cancel")
    for job in watched:
        story = studio.events(job)
        states = [data["state"] for _, kind, data in story if kind == "state"]
        assert states == ["queued", "canceled"]
        assert studio.events(job, after=story[-1][0]) == []


def test_a_revoked_key_sees_no_more(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(following, "LOOK_AT_KEYS_EVERY", 0.0)
    job = studio.submit("build_model", studio.subject())
    store = studio.http.app.state.store  # type: ignore[attr-defined]

    def revoke() -> None:
        with store.write() as session:
            session.execute(update(ApiKey).values(revoked_at=now()))

    later = threading.Timer(1, revoke)
    later.start()
    assert [data["state"] for _, _, data in studio.events(job)] == ["queued"]
    later.join()


def test_workers_say_what_they_can_do(studio: Studio) -> None:
    settings = studio.http.app.state.settings  # type: ignore[attr-defined]
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    can = abilities(settings)
    with store.write() as session:
        show_life(session, "short", can, 2)
    (worker,) = studio.get("/v1/workers")["items"]
    assert {"build_model", "fit_activations"} <= set(worker["kinds"])
    assert "fit_geometry" not in worker["kinds"]
    assert (worker["memory_mb"], worker["slots"]) == (settings.solver_memory_mb, 2)
    with pytest.raises(ValueError, match="bake_bread"):
        abilities(settings, ["bake_bread"])


def test_a_log_is_not_kept_without_end() -> None:
    class Flood:
        def take(self) -> tuple[list[str], int]:
            return ["again"] * 450, 0

    process = SolverProcess.__new__(SolverProcess)
    process._log = Flood()
    process._room = MOST_LINES_KEPT
    kept = [line for _ in range(60) for line in process.lines()]
    assert len(kept) == MOST_LINES_KEPT + 1
    assert kept[-1].startswith("...")
