"""Streams of events and downloads: so many a key and a tenant, counted by who is really there."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

from myoface.client import Client
from myoface.errors import ApiError
from myoface.resources import Job
from service.app import create_app
from service.settings import Settings
from service.store.database import Database
from service.store.files import files_at
from service.store.models import DEFAULT_TENANT, Artifact, Rig
from tests.hostile.edge import serving
from tests.service_client import Studio, eventually


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(
        data_dir=tmp_path,
        max_key_streams=2,
        max_tenant_streams=3,
        max_key_downloads=2,
        max_tenant_downloads=3,
    )


@pytest.fixture
def studio(settings: Settings) -> Iterator[Studio]:
    with (
        serving(create_app(settings), 30) as port,
        httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=10) as http,
    ):
        yield Studio(http, settings.admin_key.read_text())


def _opened(studio: Studio, key: str, job_id: str) -> tuple[socket.socket, int]:
    """Open a stream over a connection of its own; returns it with the status of the answer."""
    return _asked(studio, key, f"/v1/jobs/{job_id}/events")


def _asked(studio: Studio, key: str, path: str) -> tuple[socket.socket, int]:
    address = (studio.http.base_url.host, studio.http.base_url.port or 80)
    connection = socket.create_connection(address, timeout=10)
    connection.sendall(
        f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {key}\r\n\r\n".encode()
    )
    return connection, int(connection.recv(4096).split()[1])


def _vanish(connection: socket.socket) -> None:
    """Drop a connection without a farewell."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    connection.close()


def test_a_key_and_a_tenant_have_so_many_streams_and_get_back_what_they_close(
    studio: Studio,
) -> None:
    job_id = studio.submit("build_model", studio.subject())
    other = studio.post("/v1/keys", name="station 2", scopes=["read"])["key"]
    path = f"/v1/jobs/{job_id}/events"
    with ExitStack() as stack:
        mine = [_opened(studio, studio.key, job_id) for _ in range(2)]
        theirs = [_opened(studio, other, job_id)]
        for connection, status in (*mine, *theirs):
            stack.callback(connection.close)
            assert status == 200
        for key, word, most in ((studio.key, "key", 2), (other, "tenant", 3)):
            headers = {"Authorization": f"Bearer {key}"}
            refused = studio.http.get(path, headers=headers)
            assert (refused.status_code, refused.json()["code"]) == (429, "stream.too_many")
            assert (refused.json()["expected"], refused.headers["Retry-After"]) == (most, "5")
            assert word in refused.json()["detail"]
        assert studio.get("/v1/me")  # what else they ask for is answered
        _vanish(mine[0][0])

        def is_free() -> bool:
            connection, status = _opened(studio, studio.key, job_id)
            stack.callback(connection.close)
            return status == 200

        eventually(is_free)


def test_a_client_that_gets_no_stream_asks_now_and_then(studio: Studio) -> None:
    job_id, other = (studio.submit("build_model", studio.subject()) for _ in range(2))
    seen: list[str] = []

    def cancel(job: Job) -> None:
        seen.append(job.state)
        if job.state == "queued":
            studio.post(f"/v1/jobs/{job_id}/cancel")

    with ExitStack() as stack:
        for _ in range(2):
            connection, status = _opened(studio, studio.key, other)
            stack.callback(connection.close)
            assert status == 200
        client = stack.enter_context(Client(str(studio.http.base_url), studio.key))
        with pytest.raises(ApiError, match="canceled"):
            client.wait(job_id, cancel)
    assert seen == ["queued", "canceled"]


def test_a_key_and_a_tenant_have_so_many_downloads(
    studio: Studio, settings: Settings, tmp_path: Path
) -> None:
    job_id = studio.submit("build_model", studio.subject())
    other = studio.post("/v1/keys", name="station 2", scopes=["read"])["key"]
    content = tmp_path / "content"
    content.write_bytes(bytes(32 * 1024**2))
    blob = files_at(settings.files).put(content)
    artifact = Artifact(
        job_id=job_id, name="rig.glb", size=blob.size, sha256=blob.sha256, media_type="x"
    )
    database = Database(settings.database)
    with database.write(DEFAULT_TENANT) as session:
        session.add(artifact)
    database.close()
    path = f"/v1/artifacts/{artifact.id}"
    signed = studio.post(f"{path}/url")["url"]
    with ExitStack() as stack:
        mine = [_asked(studio, studio.key, path) for _ in range(2)]
        for connection, status in (*mine, _asked(studio, other, path)):
            stack.callback(connection.close)
            assert status == 200
        for key, word, most in ((studio.key, "key", 2), (other, "tenant", 3)):
            refused = studio.http.get(path, headers={"Authorization": f"Bearer {key}"})
            assert (refused.status_code, refused.json()["code"]) == (429, "download.too_many")
            assert (refused.json()["expected"], refused.headers["Retry-After"]) == (most, "5")
            assert word in refused.json()["detail"]
        assert studio.http.get(signed).status_code == 429  # the tenant's, too
        assert studio.get("/v1/me")
        _vanish(mine[0][0])
        eventually(lambda: studio.http.head(path).status_code == 200)


def test_an_archive_is_a_download_and_its_slow_readers_hold_nobody_up(
    studio: Studio, settings: Settings, tmp_path: Path
) -> None:
    subject = studio.subject()
    job_id = studio.submit("build_model", subject)
    content = tmp_path / "content"
    content.write_bytes(bytes(32 * 1024**2))
    blob = files_at(settings.files).put(content)
    database = Database(settings.database)
    with database.write(DEFAULT_TENANT) as session:
        rig = Rig(
            job_id=job_id, subject_id=subject, model_job_id=job_id, expressions=[], summary={}
        )
        file = {"size": blob.size, "sha256": blob.sha256, "media_type": "x"}
        session.add_all([rig, Artifact(job_id=job_id, name="rig.npz", **file)])
    database.close()
    path = f"/v1/rigs/{rig.id}/archive"
    with ExitStack() as stack:
        mine = [_asked(studio, studio.key, path) for _ in range(2)]
        for connection, status in mine:
            stack.callback(connection.close)
            assert status == 200
        refused = studio.http.get(path)
        assert (refused.status_code, refused.json()["code"]) == (429, "download.too_many")
        assert studio.get(f"/v1/rigs/{rig.id}")["artifacts"]
        assert studio.post("/v1/subjects", name="Another")  # no reader holds the database
        _vanish(mine[0][0])
        eventually(lambda: studio.http.head(path).status_code == 200)


def test_a_stream_of_a_job_that_is_not_there_takes_no_place(studio: Studio) -> None:
    for _ in range(5):
        missing = studio.http.get("/v1/jobs/00000000-0000-4000-8000-000000000000/events")
        assert missing.status_code == 404
    job_id = studio.submit("build_model", studio.subject())
    connection, status = _opened(studio, studio.key, job_id)
    connection.close()
    assert status == 200
