"""Reading needs no write: on a full disk, and while somebody else has the write lock."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from service.settings import Settings
from service.store.ballast import Ballast
from service.store.models import ApiKey, now
from tests.campaigns.chaos.disk import Disk, small_disk
from tests.service_client import Studio, eventually, served


def _long_unused(studio: Studio) -> None:
    """Make it look as if the key's last use were long ago: the next one would be noted."""
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    with store.write() as session:
        session.execute(update(ApiKey).values(last_used_at=now() - timedelta(hours=1)))


def test_reading_waits_for_no_writer(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        _long_unused(studio)
        with closing(sqlite3.connect(tmp_path / "myoface.db", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            started = time.monotonic()
            assert studio.get("/v1/subjects")["items"] == []
            assert time.monotonic() - started < 10
            other.execute("ROLLBACK")
        key = studio.get("/v1/me")["key_id"]
        recent = (now() - timedelta(minutes=5)).isoformat()[:16]

        def used() -> str:
            found = studio.get("/v1/keys")["items"]
            return str(next(each["last_used_at"] for each in found if each["id"] == key))

        eventually(lambda: used() > recent, seconds=60)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    with small_disk(tmp_path / "data") as disk:
        if disk is None:
            pytest.skip("this machine mounts no disk")
        yield disk


def test_a_full_disk_is_read_and_made_room_on(disk: Disk, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data", files_dir=tmp_path / "files")
    with served(settings) as studio:
        kept = Ballast(settings.data_dir, 2 * 1024**2, 1024**2)
        kept.lay()
        studio.http.app.state.ballast = kept  # type: ignore[attr-defined]
        subjects = [studio.post("/v1/subjects", name="Alex")["id"] for _ in range(20)]
        assert studio.http.get("/readyz").json()["checks"]["database"] == "ok"
        _long_unused(studio)
        disk.fill()
        studio.http.app.state.readiness._asked = -1e9  # type: ignore[attr-defined]
        answers = [studio.http.post("/v1/subjects", json={"name": "x" * 200}) for _ in range(200)]
        refused = [answer for answer in answers if not answer.is_success]
        assert refused
        assert {(answer.status_code, answer.json()["code"]) for answer in refused} == {
            (507, "storage.full")
        }
        assert len(studio.get("/v1/subjects?limit=20")["items"]) == 20
        assert studio.get("/v1/me")["tenant"] == "default"
        assert studio.http.get("/readyz").json()["checks"]["database"] == "failed"
        assert os.path.exists(settings.data_dir / "ballast")
        deleted = studio.http.delete(f"/v1/subjects/{subjects[0]}")
        assert deleted.is_success, deleted.text
        assert not os.path.exists(settings.data_dir / "ballast")
        disk.clear()
        kept.lay()
        assert os.path.exists(settings.data_dir / "ballast")
        assert studio.post("/v1/subjects", name="Alex")["id"]


def _template(studio: Studio) -> str:
    upload = studio.upload("face.npz", b"a template")
    made = studio.post("/v1/templates", name="face", upload_id=upload)
    return f"/v1/templates/{made['id']}"


def _scan(studio: Studio) -> str:
    subject = studio.subject()
    return f"/v1/subjects/{subject}/captures/{studio.capture(subject, 'smile')}"


DELETABLE: dict[str, Callable[[Studio], str]] = {
    "subject": lambda studio: f"/v1/subjects/{studio.subject()}",
    "capture": _scan,
    "template": _template,
    "upload": lambda studio: f"/v1/uploads/{studio.upload('smile.obj', b'a scan')}",
    "unfinished upload": lambda studio: studio.start_upload("smile.obj", 6),
    "key": lambda studio: f"/v1/keys/{studio.post('/v1/keys', name='x', scopes=['read'])['id']}",
    "webhook": lambda studio: (
        f"/v1/webhooks/{studio.post('/v1/webhooks', url='https://x.example')['id']}"
    ),
}


@pytest.mark.parametrize("what", DELETABLE)
def test_whatever_is_deleted_has_the_ballast_s_room(tmp_path: Path, what: str) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        path = DELETABLE[what](studio)
        full = Ballast(tmp_path, 1000, 1 << 60)
        full.lay()
        ballast = tmp_path / "ballast"
        studio.http.app.state.ballast = full  # type: ignore[attr-defined]
        assert studio.http.delete(path, headers={"Authorization": ""}).status_code == 401
        assert studio.http.get(path).is_success or what == "key"
        assert ballast.exists()
        assert studio.http.delete(path).status_code == 204
        assert not ballast.exists()


def test_ballast_is_given_up_when_it_is_needed_only(tmp_path: Path) -> None:
    ballast = Ballast(tmp_path, 1000, 10)
    ballast.lay()
    assert (tmp_path / "ballast").stat().st_size == 1000
    ballast.drop()
    assert (tmp_path / "ballast").exists()
    Ballast(tmp_path, 1000, 1 << 60).drop()
    assert not (tmp_path / "ballast").exists()
    Ballast(tmp_path, 1 << 60, 10).lay()
    assert not (tmp_path / "ballast").exists()
    Ballast(None).lay()
    Ballast(None).drop()
