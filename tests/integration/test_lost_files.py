"""Stored files that are lost or damaged are found, named and answered for."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from myoface.doctor import service as doctor
from service.access.bootstrap import add_tenant
from service.access.keys import Keyring
from service.queue.states import State
from service.secret import secret
from service.settings import Settings
from service.store.database import Store
from service.store.integrity import LostFileError, faults
from service.store.models import DEFAULT_TENANT, FrameChunk, Job, new_id
from service.system.scrubber import Scrubber
from tests.service_client import Studio, eventually, served
from worker.abilities import abilities
from worker.supervise import Supervisor

DAMAGES = ("lost", "damaged")
LARGE = 3 << 20


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    found = Settings(data_dir=tmp_path, scrub_per_minute=0)
    if isinstance(found.files, str):
        pytest.skip("files are damaged in a folder here")
    return found


@pytest.fixture
def studio(settings: Settings) -> Iterator[Studio]:
    with served(settings) as studio:
        yield studio


@pytest.fixture
def store(studio: Studio) -> Store:
    return studio.http.app.state.store  # type: ignore[attr-defined, no-any-return]


def _spoil(store: Store, sha256: str, how: str) -> Path:
    """Lose or damage a stored file, by its last byte; return where it is."""
    path: Path = store.files.path(sha256)  # type: ignore[attr-defined]
    content = path.read_bytes()
    path.unlink()
    if how == "damaged":
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    return path


def _artifact(studio: Studio, store: Store, tmp_path: Path, size: int = 100) -> tuple[str, str]:
    """Return id and sha256 of the file that a job left."""
    source = tmp_path / "source"
    source.write_bytes(os.urandom(size))
    sha256 = store.files.put(source).sha256
    job = studio.submit("build_model", studio.subject())
    studio.pretend(job, {"model.npz": sha256})
    [artifact] = studio.job(job)["result"]["artifacts"]
    return artifact["id"], sha256


@pytest.mark.parametrize("how", DAMAGES)
def test_a_file_that_is_not_whole_is_gone_and_comes_back(
    how: str, studio: Studio, store: Store, tmp_path: Path
) -> None:
    artifact, sha256 = _artifact(studio, store, tmp_path)
    whole = (tmp_path / "source").read_bytes()
    url = f"/v1/artifacts/{artifact}"
    path = _spoil(store, sha256, how)
    for method, headers in (
        ("GET", {}),
        ("HEAD", {}),
        ("GET", {"Range": "bytes=0-9"}),
        ("HEAD", {"Range": "bytes=0-9"}),
    ):
        answer = studio.http.request(method, url, headers=headers)
        assert answer.status_code == 410, (method, headers)
        if method == "GET":
            problem = answer.json()
            assert (problem["code"], problem["artifact_id"]) == ("files.lost", artifact)
            assert problem["detail"] == f"model.npz is {how} in the file store"
    assert studio.get("/v1/usage")["lost_files"] == 1
    assert f'myoface_file_faults{{fault="{how}"}} 1.0' in studio.http.get("/metrics").text
    path.write_bytes(whole)  # the operator brings it back
    assert studio.http.get(url).content == whole
    assert studio.http.head(url).status_code == 200
    assert studio.get("/v1/usage")["lost_files"] == 0


def test_a_file_that_was_cut_off_is_gone_at_once(
    studio: Studio, store: Store, tmp_path: Path
) -> None:
    artifact, sha256 = _artifact(studio, store, tmp_path)
    path = _spoil(store, sha256, "damaged")
    path.write_bytes(path.read_bytes()[:50])
    assert studio.http.head(f"/v1/artifacts/{artifact}").status_code == 410


def test_a_large_damaged_file_is_cut_off_and_then_gone(
    studio: Studio, store: Store, tmp_path: Path
) -> None:
    artifact, sha256 = _artifact(studio, store, tmp_path, LARGE)
    url = f"/v1/artifacts/{artifact}"
    assert len(studio.http.get(url).content) == LARGE
    _spoil(store, sha256, "damaged")
    with pytest.raises(LostFileError):  # beyond this process: a connection that breaks
        studio.http.get(url)
    assert studio.http.get(url).status_code == 410
    assert studio.http.get(url, headers={"Range": "bytes=5-9"}).status_code == 410


@pytest.mark.parametrize("how", DAMAGES)
def test_frames_that_are_not_whole_are_gone(
    how: str, studio: Studio, store: Store, tmp_path: Path
) -> None:
    chunk = tmp_path / "000000-000001.json"
    chunk.write_text('{"frames": [], "picture": "AAAA"}')
    blob = store.files.put(chunk)
    subject = studio.subject()
    job = new_id()
    request = {"options": {}, "rig_id": None, "captures": [], "kind": "simulate"}
    row: dict[str, Any] = {"id": job, "subject_id": subject, "kind": "simulate", "queue": "long"}
    with store.of(DEFAULT_TENANT).write() as session:
        session.add(Job(**row, request=request, inputs=[], max_attempts=3))
        session.flush()
        session.add(FrameChunk(job_id=job, first=0, last=1, attempt=1, **vars(blob)))
    assert studio.http.get(f"/v1/jobs/{job}/frames/picture").status_code == 200
    _spoil(store, blob.sha256, how)
    for path in (f"/v1/jobs/{job}/frames", f"/v1/jobs/{job}/frames/picture"):
        answer = studio.http.get(path)
        assert answer.status_code == 410, answer.text
        assert (answer.json()["code"], answer.json()["job_id"]) == ("files.lost", job)


@pytest.mark.parametrize("how", DAMAGES)
def test_a_job_on_a_file_that_is_not_whole_fails_once_and_names_it(
    how: str, studio: Studio, store: Store, settings: Settings
) -> None:
    subject = studio.subject()
    job_id = studio.submit("build_model", subject)
    [capture] = studio.get(f"/v1/subjects/{subject}/captures")["items"]
    _spoil(store, capture["sha256"], how)
    supervisor = Supervisor(store, settings, abilities(settings), threading.Event())
    assert supervisor.run_next("short")
    job = studio.job(job_id)
    assert (job["state"], job["attempt"]) == ("failed", 1)
    expected = f"neutral of Alex.obj of neutral, is {how} in the file store"
    assert job["error"]["code"] == "files.lost"
    assert job["error"]["message"].endswith(expected)
    assert job["error"]["capture"] == "neutral"
    with store.read() as session:
        assert session.get_one(Job, job_id).lost == 0
        assert session.scalars(select(Job.state)).all() == [State.FAILED]
    assert [path.name for path in settings.work.iterdir()] == ["caches"]


def test_the_scrubber_finds_what_nobody_reads(
    studio: Studio, store: Store, settings: Settings
) -> None:
    subject = studio.subject()
    studio.capture(subject, "smile")
    studio.capture(subject, "frown")
    scans = {
        each["name"]: each["sha256"]
        for each in studio.get(f"/v1/subjects/{subject}/captures")["items"]
    }
    _spoil(store, scans["smile"], "damaged")
    _spoil(store, scans["frown"], "lost")
    expected = {scans["smile"]: "damaged", scans["frown"]: "lost"}

    def known() -> dict[str, str]:
        with store.read() as session:
            return faults(session)

    quick = settings.model_copy(update={"scrub_per_minute": 60_000})
    scrubber = Scrubber(store, quick)
    second = Scrubber(store, quick)
    scrubber.start()
    second.start()
    eventually(lambda: known() == expected)
    found = doctor.lost_files(store)
    assert found.verdict == "fault"
    assert f"damaged: capture smile of subject {subject}" in found.found
    assert f"lost: capture frown of subject {subject}" in found.found
    assert "capture neutral" not in found.found
    studio.http.delete(f"/v1/subjects/{subject}")
    eventually(lambda: known() == {})
    for each in (scrubber, second):
        each.stop()
    assert doctor.lost_files(store).verdict == "ok"


def test_a_studio_is_told_of_its_own_files_only(
    studio: Studio, store: Store, settings: Settings, tmp_path: Path
) -> None:
    artifact, sha256 = _artifact(studio, store, tmp_path)
    _spoil(store, sha256, "damaged")
    assert studio.http.get(f"/v1/artifacts/{artifact}").status_code == 410
    key = tmp_path / "north.key"
    add_tenant(store, Keyring(store, secret(settings)), "North", key)
    assert studio.get("/v1/usage")["lost_files"] == 1
    assert Studio(studio.http, key.read_text()).get("/v1/usage")["lost_files"] == 0
