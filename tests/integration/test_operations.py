"""The doctor, on a service with something in it."""

from __future__ import annotations

from datetime import timedelta
from pathlib import Path

from sqlalchemy import update

from myoface.doctor import service as doctor
from service.settings import Settings
from service.store.database import Store
from service.store.models import Job, now
from tests.service_client import served


def _store(settings: Settings) -> Store:
    return Store(settings.database, settings.files, settings.broker)


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
            "stored files": "ok",
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
