"""Backup, restore and the doctor, on a service with something in it."""

from __future__ import annotations

import json
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from myoface.backup import DELETIONS, DUMPS, back_up, note_deletions, restore
from myoface.doctor import service as doctor
from myoface.errors import StackError
from service.settings import Settings
from service.store.database import Store
from service.store.models import Job, now
from tests.servers.production import Production
from tests.service_client import served


@pytest.fixture
def fresh(parts: Production | None, tmp_path: Path) -> Settings:
    """Settings of a service that has nothing, on parts of its own."""
    own = (
        {key.removeprefix("MYOFACE_").lower(): value for key, value in parts.fresh().items()}
        if (parts)
        else {}
    )
    return Settings(data_dir=tmp_path / "fresh", **own)


def _store(settings: Settings) -> Store:
    return Store(settings.database, settings.files, settings.broker)


def test_a_backup_brings_everything_back_but_not_the_deleted(
    tmp_path: Path, fresh: Settings
) -> None:
    settings, folder = Settings(data_dir=tmp_path / "old"), tmp_path / "backup"
    with served(settings) as studio:
        key = studio.key
        kept, gone = studio.subject(), studio.post("/v1/subjects", name="Bo")["id"]
        smile = studio.capture(gone, "smile")
        job = studio.submit("build_model", kept)
        first = back_up(settings, folder)
        assert len(first.files) == 2
        assert not first.missing
        studio.http.delete(f"/v1/subjects/{gone}")
        note_deletions(_store(settings), folder)
    scans = {path.name for path in (folder / "files").glob("??/*")}
    assert scans == set(first.files)
    manifest, again = restore(fresh, folder)
    assert (manifest, again) == (first, 1)
    fresh.admin_key.write_text(key)
    with served(fresh) as studio:
        assert studio.get(f"/v1/subjects/{kept}")["name"] == "Alex"
        assert studio.job(job)["state"] == "queued"
        assert studio.http.get(f"/v1/subjects/{gone}").status_code == 404
        assert studio.http.get(f"/v1/subjects/{gone}/captures/{smile}").status_code == 404
    store = _store(fresh)
    assert all(store.files.exists(sha256) for sha256 in first.files)
    with pytest.raises(StackError, match="tables already"):
        restore(fresh, folder)


def test_a_damaged_backup_changes_nothing(tmp_path: Path, fresh: Settings) -> None:
    settings, folder = Settings(data_dir=tmp_path / "old"), tmp_path / "backup"
    with served(settings) as studio:
        studio.subject()
        back_up(settings, folder)
    [scan] = (folder / "files").glob("??/*")
    content = scan.read_bytes()
    scan.unlink()
    scan.write_bytes(content + b"x")
    with pytest.raises(StackError, match="missing or damaged"):
        restore(fresh, folder)
    dump = next(folder / name for name in DUMPS.values() if (folder / name).exists())
    dump.write_bytes(dump.read_bytes() + b"x")
    with pytest.raises(StackError, match="damaged"):
        restore(fresh, folder)
    with pytest.raises(StackError, match="no whole backup"):
        restore(fresh, tmp_path)
    assert not _store(fresh).database.engine.dialect.has_table(
        _store(fresh).database.engine.connect(), "jobs"
    )


def test_a_later_backup_forgets_what_was_deleted(tmp_path: Path) -> None:
    settings, folder = Settings(data_dir=tmp_path / "old"), tmp_path / "backup"
    with served(settings) as studio:
        subject = studio.subject()
        assert len(back_up(settings, folder).files) == 1
        studio.http.delete(f"/v1/subjects/{subject}")
        assert back_up(settings, folder).files == []
    assert not list((folder / "files").glob("??/*"))
    [deleted] = json.loads((folder / DELETIONS).read_text())
    assert deleted["object_id"] == subject


def test_the_doctor_finds_what_is_wrong(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with served(settings) as studio:
        job_id = studio.submit("build_model", studio.subject())
        found = {finding.subject: finding for finding in doctor.stores(settings)}
        assert {name: each.verdict for name, each in found.items()} == {
            "files": "ok",
            "database": "ok",
            "clock": "ok",
            "keys": "ok",
            "workers": "warning",
            "jobs": "ok",
        }
        store = _store(settings)
        with store.write() as session:
            old = now() - timedelta(hours=1)
            session.execute(update(Job).where(Job.id == job_id).values(created_at=old))
        assert "1 queued" in doctor.stuck(store).found
    assert doctor.secret(settings).verdict == "ok"
    path = tmp_path / "secret"
    path.chmod(0o644)
    assert "others can read" in doctor.secret(settings).found
    path.write_bytes(b"of another host, and long enough")
    assert "does not know" in doctor.keys(store, settings).found
    elsewhere = settings.model_copy(update={"broker_url": "redis://127.0.0.1:1/0"})
    assert doctor.broker(elsewhere).verdict == "fault"
