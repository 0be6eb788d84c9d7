"""Who has read a face is in the audit log, and reading does not wait for it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from service.access.principal import Principal
from service.records import audit
from service.records.audit import ReadLog
from service.settings import Settings
from service.store.models import DEFAULT_TENANT, Artifact
from tests.service_client import Studio, eventually, served


def _artifact(studio: Studio, folder: Path) -> str:
    (folder / "face").write_bytes(b"a face, in bytes")
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    sha256 = store.files.put(folder / "face").sha256
    job = studio.submit("build_model", studio.subject())
    studio.pretend(job, {"rig.glb": sha256})
    artifact: str = studio.job(job)["result"]["artifacts"][0]["id"]
    with store.read() as session:
        assert session.get_one(Artifact, artifact).size == 16
    return artifact


def _entries(studio: Studio, object_id: str) -> list[dict[str, Any]]:
    return [
        each
        for each in studio.get(f"/v1/audit?object_id={object_id}")["items"]
        if each["action"] == "artifact.downloaded"
    ]


@pytest.mark.long
def test_a_download_is_noted_once_an_hour_for_a_key(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        artifact = _artifact(studio, tmp_path)
        path = f"/v1/artifacts/{artifact}"
        tag = studio.http.head(path).headers["ETag"]
        assert studio.http.get(path, headers={"If-None-Match": tag}).status_code == 304
        for start in range(10):
            part = {"Range": f"bytes={start}-{start}", "X-Request-Id": f"part-{start}"}
            assert studio.http.get(path, headers=part).status_code == 206
        eventually(lambda: bool(_entries(studio, artifact)), seconds=60)
        [entry] = _entries(studio, artifact)
        assert entry["key_id"] == studio.get("/v1/me")["key_id"]
        assert entry["request_id"] == "part-0"
        url = studio.post(f"{path}/url")["url"]
        assert studio.http.get(url, headers={"Authorization": ""}).status_code == 200
        eventually(lambda: len(_entries(studio, artifact)) == 2, seconds=60)
        assert _entries(studio, artifact)[0]["key_id"] == "signed-url"


def test_reading_goes_on_while_nothing_can_be_noted(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        artifact = _artifact(studio, tmp_path)
        with closing(sqlite3.connect(tmp_path / "myoface.db", isolation_level=None)) as other:
            other.execute("BEGIN IMMEDIATE")
            assert studio.http.get(f"/v1/artifacts/{artifact}").status_code == 200
            other.execute("ROLLBACK")
        eventually(lambda: bool(_entries(studio, artifact)), seconds=60)


def test_what_cannot_be_written_waits_within_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(audit, "MOST_WAITING", 3)
    monkeypatch.setattr(audit, "MOST_KNOWN", 2)
    with served(Settings(data_dir=tmp_path)) as studio:
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        log = ReadLog(store)
        who = Principal(DEFAULT_TENANT, "key", frozenset(), "request")
        for number in range(5):
            log.note(who, "artifact.downloaded", f"file-{number}")
        assert len(log._waiting) == 3
        assert len(log._known) == 2

        def refuse() -> None:
            raise OSError("no room")

        with monkeypatch.context() as full:
            full.setattr(store, "write", refuse)
            with pytest.raises(OSError, match="no room"):
                log._round()
        log._round()
        log._round()
        found = [len(_entries(studio, f"file-{number}")) for number in range(5)]
        assert found == [1, 1, 1, 0, 0]


@pytest.mark.long
def test_the_last_reads_are_written_at_the_end(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with served(settings) as studio:
        artifact = _artifact(studio, tmp_path)
        studio.http.get(f"/v1/artifacts/{artifact}")
    with served(settings) as studio:
        assert len(_entries(studio, artifact)) == 1
