"""What is deleted is gone: by request, after its time, and with files that others have kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select, update
from sqlalchemy.orm import Session

from service.queue import table
from service.settings import Settings
from service.store import deletion, retention
from service.store.database import Database, Store
from service.store.models import (
    DEFAULT_TENANT,
    AuditEntry,
    Capture,
    Deletion,
    Job,
    Rig,
    Subject,
    Tenant,
    Upload,
    now,
)
from tests.service_client import Studio, eventually, running, served

OLD = now() - timedelta(days=40)


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def _store(studio: Studio) -> Store:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    return store


def _settings(studio: Studio, **days: int) -> Settings:
    settings: Settings = studio.http.app.state.settings  # type: ignore[attr-defined]
    return settings.model_copy(update=days)


def _stored(studio: Studio) -> set[str]:
    return {stored.sha256 for stored in _store(studio).files.list_stored()}


def test_a_receipt_says_when_the_last_file_was_gone(studio: Studio) -> None:
    subject = studio.subject()
    studio.capture(subject, "smile")
    other = studio.post("/v1/subjects", name="Bo")["id"]
    studio.capture(other, "smile")  # the same bytes
    answer = studio.http.delete(f"/v1/subjects/{subject}")
    assert answer.status_code == 204
    receipt = studio.get(answer.headers["Location"])
    assert receipt["rows_at"] is not None
    assert receipt["files_at"] is None
    for _ in range(2):  # put aside, and removed
        deletion.close_receipts(_store(studio), 0)
        assert studio.get(answer.headers["Location"])["files_at"] is None
        deletion.collect_garbage(_store(studio), age=-60)
    deletion.close_receipts(_store(studio), 0)
    receipt = studio.get(answer.headers["Location"])
    assert receipt["files_at"] is not None
    assert "Alex" not in str(receipt)
    assert studio.get("/v1/deletions")["items"] == [receipt]
    kept = studio.get(f"/v1/subjects/{other}/captures")["items"][0]
    assert _stored(studio) == {kept["sha256"]}
    actions = studio.get(f"/v1/audit?object_id={subject}")["items"]
    assert [each["action"] for each in actions] == ["subject.deleted", "subject.created"]


def test_a_receipt_does_not_tell_that_somebody_has_the_same_file(studio: Studio) -> None:
    """What only this studio had takes two ages of garbage, and so does what others have."""
    shared = studio.subject()
    unique = studio.post("/v1/subjects", name="Bo")["id"]
    studio.capture(studio.subject(), "smile")
    studio.capture(shared, "smile")
    studio.capture(unique, "frown")
    store = _store(studio)
    age = 300.0
    receipts = [
        studio.http.delete(f"/v1/subjects/{each}").headers["Location"] for each in (shared, unique)
    ]
    for _ in range(2):
        deletion.collect_garbage(store, age=-60)

    def ends() -> list[bool]:
        deletion.close_receipts(store, age)
        return [studio.get(each)["files_at"] is not None for each in receipts]

    assert ends() == [False, False]
    for seconds, closed in ((600, False), (721, True)):
        with store.write() as session:
            session.execute(update(Deletion).values(rows_at=now() - timedelta(seconds=seconds)))
        assert ends() == [closed, closed]


def test_landmarks_that_were_replaced_go_with_their_scan(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    smile = studio.raw(subject, "smile")
    path = f"/v1/subjects/{subject}/captures/{smile}/landmarks"
    for content in (b"[1]", b"[2]"):
        marks = {"upload_id": studio.upload("smile of Alex.json", content)}
        assert studio.http.put(path, json=marks).status_code == 200
    receipt = studio.http.delete(f"/v1/subjects/{subject}").headers["Location"]
    for _ in range(2):
        deletion.collect_garbage(_store(studio), age=-60)
    deletion.close_receipts(_store(studio), 0)
    assert studio.get(receipt)["files_at"] is not None
    assert _stored(studio) == set()
    with _store(studio).read() as session:
        assert session.scalars(select(Upload)).all() == []


def test_another_upload_of_the_same_bytes_stays(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    smile = studio.capture(subject, "smile")
    template = studio.post("/v1/templates", name="x", upload_id=studio.upload("a.npz", b"PK"))["id"]
    others = [studio.upload("of Bo.obj", b"# smile"), studio.upload("other.npz", b"PK")]
    for path in (f"/v1/subjects/{subject}/captures/{smile}", f"/v1/templates/{template}"):
        assert studio.http.delete(path).status_code == 204
    with _store(studio).read() as session:
        assert set(session.scalars(select(Upload.id))) == set(others)


def test_a_scan_takes_another_one_s_place_or_nothing_is_done(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.capture(subject, "smile")
    frown = studio.capture(subject, "frown")
    made = studio.post("/v1/keys", name="station", scopes=["read", "write"])
    station = {"Authorization": f"Bearer {made['key']}"}
    path = f"/v1/subjects/{subject}/captures"
    body = {"name": "Smile", "role": "expression", "replaces": smile}

    def status(**more: Any) -> tuple[int, str | None]:
        answer = studio.http.post(path, json={**body, **more}, headers=station)
        return answer.status_code, answer.json().get("code")

    wrong = studio.upload("smile.png", b"x")
    assert status(upload_id=wrong) == (422, "capture.format")
    right = studio.upload("smile.obj", b"again")
    assert status(upload_id=right, name="frown") == (409, "capture.name_taken")
    assert status(upload_id=right, replaces=right) == (404, "capture.unknown")
    job = studio.submit("check_scan", subject, captures=[frown])
    assert status(upload_id=right) == (409, "subject.busy")
    studio.post(f"/v1/jobs/{job}/cancel")
    assert {each["id"] for each in studio.get(path)["items"]} >= {smile, frown}
    assert status(upload_id=right) == (201, None)
    found = {each["name"]: each["id"] for each in studio.get(path)["items"]}
    assert found.keys() == {"neutral", "Smile", "frown"}
    assert found["Smile"] != smile
    assert [each["object_id"] for each in studio.get("/v1/deletions")["items"]] == [smile]
    log = studio.get("/v1/audit?limit=2")["items"]
    assert {(each["action"], each["object_id"]) for each in log} == {
        ("capture.created", found["Smile"]),
        ("capture.deleted", smile),
    }


def test_a_receipt_names_the_jobs_that_read_what_is_gone(studio: Studio) -> None:
    subject = studio.subject()
    take = studio._add(subject, "take", "markers", {})
    check = studio.submit("check_markers", subject, captures=[take])
    path = f"/v1/subjects/{subject}/captures/{take}"
    refused = studio.http.delete(path)  # what a job that is not over reads stays
    assert (refused.status_code, refused.json()["code"]) == (409, "subject.busy")
    assert refused.json()["job_ids"] == [check]
    _end(studio, check)
    receipt = studio.get(studio.http.delete(path).headers["Location"])
    assert receipt["read_by"] == [check]
    assert studio.job(check)["state"] == "succeeded"
    everything = studio.get(studio.http.delete(f"/v1/subjects/{subject}").headers["Location"])
    assert everything["read_by"] == []  # they go with it


def test_readers_of_a_registration_are_those_of_its_scan(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Ada")["id"]
    neutral = studio.raw(subject, "neutral", "neutral")
    registration = studio.submit("register_scan", subject, captures=[neutral])
    studio.pretend(
        registration, {"registered.ply": _store(studio).files.put(Path(__file__)).sha256}
    )
    model = studio.submit("build_model", subject)
    _end(studio, model)
    path = f"/v1/subjects/{subject}/captures/{neutral}"
    assert studio.get(studio.http.delete(path).headers["Location"])["read_by"] == [model]
    assert studio.http.get(f"/v1/jobs/{registration}").status_code == 404


def test_jobs_that_go_by_themselves_name_their_readers(studio: Studio) -> None:
    subject = studio.subject()
    take = studio._add(subject, "take", "markers", {})
    left = {"model.npz": _store(studio).files.put(Path(__file__)).sha256}
    model = studio.submit("build_model", subject)
    studio.pretend(model, left)
    smile = studio.capture(subject, "smile")
    fit = studio.submit("fit_geometry", subject, captures=[smile])
    rig = {"subject_id": subject, "model_job_id": model}
    studio.pretend(fit, {"rig.npz": left["model.npz"]}, rig=rig)
    rig_id = studio.job(fit)["result"]["rig_id"]
    check = studio.submit("check_markers", subject, captures=[take], rig_id=rig_id)
    _end(studio, check)
    with _store(studio).write() as session:
        session.execute(update(Rig).values(created_at=OLD))
    retention.enforce(_store(studio), _settings(studio, retain_rigs=30))
    (receipt,) = studio.get("/v1/deletions")["items"]
    assert (receipt["kind"], receipt["object_id"]) == ("rig", rig_id)
    assert receipt["read_by"] == [check]


def test_a_busy_subject_is_deleted_when_its_jobs_have_stopped(studio: Studio) -> None:
    subject = studio.subject()
    waiting, running_job = (studio.submit("build_model", subject) for _ in range(2))
    with _store(studio).write() as session:
        claim = table.take(session, running_job, "worker", 30)
        assert claim
    assert studio.http.delete(f"/v1/subjects/{subject}").status_code == 409
    answer = studio.http.delete(f"/v1/subjects/{subject}?cancel=true")
    again = studio.http.delete(f"/v1/subjects/{subject}?cancel=true")
    assert again.headers["Location"] == answer.headers["Location"]
    assert answer.status_code == 202
    assert studio.job(waiting)["state"] == "canceled"
    assert studio.job(running_job)["state"] == "canceling"
    retention.enforce(_store(studio), _settings(studio))
    assert studio.get(answer.headers["Location"])["rows_at"] is None
    with _store(studio).write() as session:
        assert table.confirm_cancel(session, running_job, claim.attempt)
    retention.enforce(_store(studio), _settings(studio))
    assert studio.get(answer.headers["Location"])["rows_at"] is not None
    for path in (f"/v1/subjects/{subject}", f"/v1/jobs/{waiting}"):
        assert studio.http.get(path).status_code == 404

    idle = studio.subject()
    studio.submit("build_model", idle)
    assert studio.http.delete(f"/v1/subjects/{idle}?cancel=true").status_code == 204


def test_a_template_goes_when_no_subject_has_it(studio: Studio) -> None:
    upload = studio.upload("anatomy.npz", b"PK")
    template = studio.post("/v1/templates", name="mine", upload_id=upload)["id"]
    subject = studio.post("/v1/subjects", name="Alex", template_id=template)["id"]
    refused = studio.http.delete(f"/v1/templates/{template}")
    assert (refused.status_code, refused.json()["subject_ids"]) == (409, [subject])
    studio.http.delete(f"/v1/subjects/{subject}")
    assert studio.http.delete(f"/v1/templates/{template}").status_code == 204
    assert studio.http.get(f"/v1/uploads/{upload}").status_code == 404


def test_what_has_been_kept_for_long_enough_goes(studio: Studio) -> None:
    subject = studio.subject()
    young = studio.subject()
    smile = studio.capture(subject, "smile")
    model, rig_job, check = (studio.submit("build_model", subject) for _ in range(3))
    _end(studio, model, check)
    with _store(studio).write() as session:
        claim = table.take(session, rig_job, "worker", 30)
        assert claim
        mine = {"tenant_id": claim.tenant_id, "job_id": rig_job, "model_job_id": model}
        rig = Rig(subject_id=subject, expressions=[], summary={}, **mine)
        assert table.succeed(session, rig_job, claim.attempt, [], rig=rig)
    _age(studio, Job, "finished_at")
    settings = _settings(studio, retain_jobs=30)
    retention.enforce(_store(studio), settings)
    assert {job["id"] for job in studio.get("/v1/jobs")["items"]} == {model, rig_job}
    assert [each["kind"] for each in studio.get("/v1/deletions")["items"]] == ["job"]

    busy = studio.submit("build_model", subject)
    _age(studio, Rig, "created_at")
    with _store(studio).write() as session:
        session.execute(update(Capture).where(Capture.id == smile).values(created_at=OLD))
    settings = _settings(studio, retain_rigs=30, retain_scans=30)
    retention.enforce(_store(studio), settings)
    assert [each["id"] for each in studio.get("/v1/rigs")["items"]] == [rig.id]
    studio.post(f"/v1/jobs/{busy}/cancel")
    retention.enforce(_store(studio), settings)
    assert studio.get("/v1/rigs")["items"] == []
    names = [each["name"] for each in studio.get(f"/v1/subjects/{subject}/captures")["items"]]
    assert names == ["neutral"]

    with _store(studio).write() as session:
        session.execute(update(Subject).where(Subject.id == subject).values(created_at=OLD))
        session.execute(update(AuditEntry).values(created_at=OLD))
    retention.enforce(_store(studio), _settings(studio, retain_subjects=30, retain_audit=30))
    assert [each["id"] for each in studio.get("/v1/subjects")["items"]] == [young]
    assert studio.get("/v1/audit")["items"] == []
    assert {each["reason"] for each in studio.get("/v1/deletions")["items"]} == {"retention"}


def test_a_round_deletes_so_many_things_and_those_of_a_tenant_at_a_time(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = _store(studio)
    with store.write() as session:
        for name in ("north", "south"):
            tenant = Tenant(name=name, retain_subjects=7)
            session.add(tenant)
            session.flush()
            for person in ("Alex", "Bo"):
                session.add(Subject(tenant_id=tenant.id, name=person, created_at=OLD))
    transactions: list[set[str]] = [set()]

    def see(session: Session, *_: Any) -> None:
        transactions[-1].update(row.tenant_id for row in session.deleted)

    monkeypatch.setattr(retention, "BATCH", 3)
    rounds = []
    event.listen(Session, "before_flush", see)
    event.listen(Session, "after_commit", lambda _: transactions.append(set()))
    for _ in range(3):
        retention.enforce(store, _settings(studio))
        with store.read() as session:
            rounds.append(session.scalar(select(func.count(Subject.id))))
    event.remove(Session, "before_flush", see)
    assert rounds == [1, 0, 0]
    assert sorted(len(tenants) for tenants in transactions if tenants) == [1, 1, 1]


def _end(studio: Studio, *job_ids: str) -> None:
    for job_id in job_ids:
        with _store(studio).write() as session:
            claim = table.take(session, job_id, "worker", 30)
            assert claim
            assert table.succeed(session, job_id, claim.attempt, [])


def _age(studio: Studio, table: Any, column: str) -> None:
    with _store(studio).write() as session:
        session.execute(update(table).values({column: OLD}))


def test_every_object_says_until_when_it_is_kept(tmp_path: Path) -> None:
    days = {"retain_subjects": 900, "retain_scans": 30, "retain_jobs": 7}
    with served(Settings(data_dir=tmp_path, **days)) as studio:
        subject = studio.subject()
        shown = studio.get(f"/v1/subjects/{subject}")
        capture = studio.get(f"/v1/subjects/{subject}/captures")["items"][0]
        job = studio.submit("build_model", subject)
        assert studio.job(job)["retain_until"] is None  # it is not over
        _end(studio, job)
        ended = studio.job(job)
        assert ended["retain_until"][:10] == str((now() + timedelta(days=7)).date())
        assert capture["retain_until"][:10] == str((now() + timedelta(days=30)).date())
        assert shown["retain_until"][:10] == str((now() + timedelta(days=900)).date())
        told = studio.get("/v1/limits")["retention"]
        assert told == {"subjects": 900, "scans": 30, "jobs": 7, "rigs": None, "audit": None}


def test_a_tenant_may_keep_things_for_fewer_days(studio: Studio) -> None:
    store = _store(studio)
    mine = studio.subject()
    week = now() - timedelta(days=8)
    with store.write() as session:
        own = session.get_one(Tenant, DEFAULT_TENANT)
        own.retain_scans = 7
        own.retain_subjects = 900
        session.add(other := Tenant(name="another studio"))
        session.flush()
        session.add(theirs := Subject(name="Bo", tenant_id=other.id))
        session.flush()
        scan = {"name": "x", "role": "neutral", "filename": "x", "size": 1, "sha256": "a" * 64}
        session.add(Capture(subject_id=theirs.id, tenant_id=other.id, **scan))
        session.flush()
        session.execute(update(Capture).values(created_at=week))
    told = studio.get("/v1/limits")["retention"]
    assert (told["scans"], told["subjects"]) == (7, 900)  # the installation keeps all
    shown = studio.get(f"/v1/subjects/{mine}/captures")["items"][0]
    assert shown["retain_until"][:10] == str((week + timedelta(days=7)).date())
    settings = _settings(studio, retain_scans=30, retain_subjects=30)
    retention.enforce(store, settings)
    with store.read() as session:
        assert session.scalars(select(Capture.subject_id)).all() == [theirs.id]
    _age(studio, Subject, "created_at")
    retention.enforce(store, settings)
    with store.read() as session:
        assert session.scalars(select(Subject)).all() == []


def test_the_database_forgets_a_name(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        database = _store(studio).database
        if not database.is_sqlite:
            pytest.skip("PostgreSQL overwrites by VACUUM, in its own time")
        name = "Somebody" + os.urandom(8).hex()
        subject = studio.post("/v1/subjects", name=name)["id"]
        studio.http.delete(f"/v1/subjects/{subject}")
        assert name.encode() in _bytes_of(database)
        with database.read() as session:
            session.scalars(select(Subject)).all()
            database.forget_deleted()  # does not wait for a reader
        database.forget_deleted()
        assert name.encode() not in _bytes_of(database)


@pytest.mark.slow
def test_a_running_service_forgets_a_name(tmp_path: Path) -> None:
    with running(tmp_path, garbage_age=0.5) as (stack, studio):
        database = Database(stack.settings.database)
        if not database.is_sqlite:
            pytest.skip("PostgreSQL overwrites by VACUUM, in its own time")
        name = "Somebody" + os.urandom(8).hex()
        subject = studio.post("/v1/subjects", name=name)["id"]
        assert name.encode() in _bytes_of(database)
        studio.http.delete(f"/v1/subjects/{subject}")
        eventually(lambda: name.encode() not in _bytes_of(database))


def _bytes_of(database: Database) -> bytes:
    """Return what the files of a database hold."""
    path = Path(str(database.url.database))
    return b"".join(each.read_bytes() for each in path.parent.glob(f"{path.name}*"))


@pytest.mark.slow
def test_a_running_service_deletes_a_busy_subject(tmp_path: Path) -> None:
    with running(tmp_path, garbage_age=0.5) as (_, studio):
        subject = studio.subject(seconds=60)
        job = studio.submit("build_model", subject)
        studio.until_working(job)
        answer = studio.http.delete(f"/v1/subjects/{subject}?cancel=true")
        assert answer.status_code == 202
        receipt = answer.headers["Location"]
        eventually(lambda: studio.get(receipt)["files_at"] is not None, seconds=30)
        assert studio.http.get(f"/v1/subjects/{subject}").status_code == 404
