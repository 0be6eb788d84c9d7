"""How fast and how much: rates of keys and quotas of tenants."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import update

from service.access import limits
from service.access.limits import Rates
from service.queue import sweep, table
from service.settings import Settings
from service.store.broker import EmbeddedBroker
from service.store.models import DEFAULT_TENANT, Capture, FrameChunk, Tenant
from tests.service_client import Studio, served

pytestmark = pytest.mark.telling


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[str]:
    folder = tmp_path / "broker"
    embedded = EmbeddedBroker(folder, folder / "valkey.sock")
    embedded.start()
    yield f"redis+socket://{folder / 'valkey.sock'}"
    embedded.stop()


def _limit(studio: Studio, **quotas: int) -> None:
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.write() as session:
        session.execute(update(Tenant).where(Tenant.id == DEFAULT_TENANT).values(**quotas))


def test_a_key_that_asks_too_fast_is_told_when_to_come_back(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path, rate_per_minute=3)) as studio:
        *answers, refused = [studio.http.get("/v1/me") for _ in range(4)]
        assert {answer.status_code for answer in answers} == {200}
        assert answers[0].headers["RateLimit-Remaining"] == "2"
        assert (refused.status_code, refused.json()["code"]) == (429, "request.rate")
        assert 1 <= int(refused.headers["Retry-After"]) <= 20
        assert refused.headers["RateLimit-Limit"] == "3"
        assert studio.http.get("/healthz").status_code == 200


def test_processes_share_a_bucket_and_go_on_without_the_broker(broker: str) -> None:
    first = Rates(broker, 4, 100)
    second = Rates(broker, 4, 100)
    taken = [rates.take("key", "studio") for rates in (first, second, first, second, first)]
    assert [each.allowed for each in taken] == [True] * 4 + [False]
    assert first.take("another", "studio").allowed
    alone = Rates("redis+socket:///nobody", 2, 100)
    assert [alone.take("key", "studio").allowed for _ in range(3)] == [True, True, False]
    shared = [Rates(broker, 100, 3), Rates("redis+socket:///nobody", 100, 3)]
    for rates in shared:
        taken = [rates.take(f"key {number}", "lab") for number in range(4)]
        assert [each.allowed for each in taken] == [True] * 3 + [False]
        assert (taken[-1].owner, taken[-1].limit) == ("tenant", 3)
    for rates in (first, second, alone, *shared):
        rates.close()


def test_a_tenant_has_room_for_so_many_bytes_and_jobs(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        used = studio.get("/v1/usage")["bytes"]
        assert used["used"] > 0  # the upload and the capture made from it count once
        assert used["limit"] is None
        _limit(studio, max_bytes=used["used"] + 10, max_queued=1, max_running=3)
        start = {"Upload-Metadata": "filename YS5vYmo="}
        too_large, no_room, fits = (
            studio.http.post("/v1/uploads", headers=start | {"Upload-Length": str(size)})
            for size in (used["used"] + 11, 11, 10)
        )
        assert (too_large.status_code, too_large.json()["code"]) == (413, "quota.bytes")
        assert (no_room.status_code, no_room.json()["code"]) == (413, "quota.bytes")
        assert "Retry-After" not in no_room.headers  # time makes no room
        assert fits.status_code == 201
        job = studio.submit("build_model", subject)
        body = {"kind": "build_model", "subject_id": subject}
        refused = studio.http.post("/v1/jobs", json=body)
        assert (refused.status_code, refused.json()["code"]) == (429, "quota.queued")
        assert "Retry-After" in refused.headers
        usage = studio.get("/v1/usage")
        assert usage["bytes"]["used"] == usage["bytes"]["limit"]
        assert usage["queued"] == {"used": 1, "limit": 1}
        assert usage["running"] == {"used": 0, "limit": 3}
        studio.post(f"/v1/jobs/{job}/cancel")
        assert studio.http.post("/v1/jobs", json=body).status_code == 201
        _limit(studio, max_bytes=used["used"], max_queued=9)  # what jobs left went beyond it
        refused = studio.http.post("/v1/jobs", json=body)
        assert (refused.status_code, refused.json()["code"]) == (413, "quota.bytes")


def test_a_tenant_without_a_quota_has_one_of_queued_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert limits.MOST_QUEUED == 10_000
    monkeypatch.setattr(limits, "MOST_QUEUED", 2)
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        assert studio.get("/v1/usage")["queued"] == {"used": 0, "limit": 2}
        for _ in range(2):
            studio.submit("build_model", subject)
        body = {"kind": "build_model", "subject_id": subject}
        refused = studio.http.post("/v1/jobs", json=body)
        assert (refused.status_code, refused.json()["code"]) == (429, "quota.queued")
        _limit(studio, max_queued=3)  # the operator may allow more
        assert studio.http.post("/v1/jobs", json=body).status_code == 201


def test_landmarks_and_frames_are_among_the_stored_bytes(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        store = studio.http.app.state.store  # type: ignore[attr-defined]

        def used() -> int:
            return int(studio.get("/v1/usage")["bytes"]["used"])

        subject = studio.subject()
        smile = studio.raw(subject, "smile")
        before = used()
        marks = studio.upload("smile.json", b"[1, 2, 3]")
        path = f"/v1/subjects/{subject}/captures/{smile}/landmarks"
        assert studio.http.put(path, json={"upload_id": marks}).status_code == 200
        assert used() == before + 9
        assert studio.http.delete(f"/v1/uploads/{marks}").status_code == 204
        assert used() == before + 9

        frames = tmp_path / "frames.json"
        frames.write_bytes(b"x" * 500)
        blob = store.files.put(frames)
        chunk = {"first": 0, "last": 9, "size": blob.size, "sha256": blob.sha256}
        job = studio.submit("build_model", subject)
        with store.write() as session:
            claim = table.take(session, job, "test", 60)
            assert claim
            table.beat(session, job, claim.attempt, 60, chunks=[chunk])
        assert used() == before + 9 + 500

        with store.write() as session:  # as a version left them that knew no sizes
            session.execute(update(Capture).values(landmarks_size=None))
            session.execute(update(FrameChunk).values(size=None))
        assert used() == before
        sweep.measure_sizes(store)
        assert used() == before + 9 + 500
