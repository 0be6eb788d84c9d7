"""Resumable uploads, by requests that a real client or network can make."""

from __future__ import annotations

import base64
import hashlib
import os
import socket
import threading
import time
import uuid
from collections.abc import AsyncIterator
from contextlib import nullcontext
from pathlib import Path

import anyio
import httpx
import pytest
import uvicorn

from service.app import create_app
from service.errors import Problem
from service.settings import Settings
from service.store.files import files_at
from service.store.models import DEFAULT_TENANT, Upload
from service.uploads.service import BUFFER, UploadService
from service.writers import Places
from tests.service_client import OFFSET_STREAM, Studio, eventually, served

SCAN = b"".join(f"v {i} 0 0\n".encode() for i in range(50_000))
SHA256 = hashlib.sha256(SCAN).hexdigest()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, max_upload_bytes=10_000_000)


@pytest.mark.telling
def test_an_upload_resumes_where_the_service_died(settings: Settings) -> None:
    with served(settings) as studio:
        http = studio.http
        location = studio.start_upload("smile.obj", len(SCAN), SHA256)
        assert studio.send(location, 0, SCAN[:1000]).headers["Upload-Offset"] == "1000"
    # Killed in the middle of a request: bytes on disk that were never counted.
    with (settings.uploads / location.rsplit("/", 1)[1]).open("ab") as part:
        part.write(b"half a line")
    with served(settings) as studio:
        http = studio.http
        assert http.head(location).headers["Upload-Offset"] == "1000"
        assert studio.send(location, 1000, SCAN[1000:]).status_code == 204
        upload = studio.get(location)
        assert (upload["state"], upload["sha256"]) == ("complete", SHA256)
    assert files_at(settings.files).read(SHA256) == SCAN
    assert not list(settings.uploads.iterdir())


@pytest.mark.parametrize("counted", [1000, len(SCAN)])
def test_bytes_that_a_power_cut_took_are_sent_again(settings: Settings, counted: int) -> None:
    with served(settings) as studio:
        location = studio.start_upload("smile.obj", len(SCAN))
        studio.send(location, 0, SCAN[:1000])
        upload_id = location.rsplit("/", 1)[1]
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        with store.write() as session:
            session.get_one(Upload, upload_id).offset = counted
        (settings.uploads / upload_id).write_bytes(SCAN[:600])
        studio.send(location, counted, SCAN[counted:])
        assert studio.http.head(location).headers["Upload-Offset"] == "600"
        assert studio.send(location, 600, SCAN[600:]).status_code == 204
        assert studio.get(location)["sha256"] == SHA256


@pytest.mark.parametrize("more", [0, 1])
def test_what_counts_on_the_way_is_no_more_than_the_end_says(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, more: int
) -> None:
    """Bytes count a megabyte at a time here; a request with too many takes them back."""
    monkeypatch.setattr("service.uploads.service.COUNT_EVERY", BUFFER)
    counted: list[int] = []
    count = UploadService._count

    def note(service: UploadService, upload: Upload, offset: int) -> Upload:
        counted.append(offset)
        return count(service, upload, offset)

    monkeypatch.setattr(UploadService, "_count", note)
    scan = SCAN * 6

    async def pieces() -> AsyncIterator[bytes]:
        for first in range(0, len(scan), 100_000):
            yield scan[first : first + 100_000]

    with served(settings) as studio:
        location = studio.start_upload("smile.obj", len(scan) - more)
        store = studio.http.app.state.store  # type: ignore[attr-defined]
        uploads = UploadService(store.of(DEFAULT_TENANT), settings)
        with pytest.raises(Problem) if more else nullcontext():
            anyio.run(uploads.receive, location.rsplit("/", 1)[1], 0, None, pieces(), Places())
        assert counted[:-1] == sorted(counted[:-1])
        assert len(counted) == len(scan) // BUFFER + 1
        assert counted[-1] == (0 if more else len(scan))
        assert studio.get(location)["offset"] == counted[-1]


def test_wrong_requests_change_nothing(settings: Settings) -> None:
    with served(settings) as studio:
        http = studio.http
        location = studio.start_upload("smile.obj", len(SCAN), SHA256)
        studio.send(location, 0, SCAN[:1000])
        wrong = base64.b64encode(hashlib.sha256(b"other").digest()).decode()
        refusals = [
            (studio.send(location, 500, SCAN[500:]), 409, "upload.offset"),
            (studio.send(location, 1000, SCAN), 413, "upload.overflow"),
            (
                studio.send(location, 1000, SCAN[1000:], **{"Upload-Checksum": f"sha256 {wrong}"}),
                460,
                "upload.checksum",
            ),
            (
                studio.send(location, 1000, b"x", **{"Upload-Checksum": "crc32 AAAA"}),
                400,
                "upload.checksum_algorithm",
            ),
            (http.patch(location, content=b"x"), 422, "request.invalid"),
        ]
        for answer, status, code in refusals:
            assert answer.headers["content-type"] == "application/problem+json"
            problem = answer.json()
            assert (answer.status_code, problem["code"]) == (status, code)
            assert problem["request_id"] == answer.headers["x-request-id"]
            assert http.head(location).headers["Upload-Offset"] == "1000"
        right = base64.b64encode(hashlib.sha1(SCAN[1000:]).digest()).decode()
        last = studio.send(location, 1000, SCAN[1000:], **{"Upload-Checksum": f"sha1 {right}"})
        assert last.status_code == 204


def test_a_file_that_is_not_the_announced_one_is_dropped(settings: Settings) -> None:
    with served(settings) as studio:
        http = studio.http
        location = studio.start_upload("smile.obj", len(SCAN), SHA256)
        answer = studio.send(location, 0, SCAN[:-1] + b" ")
        assert (answer.status_code, answer.json()["code"]) == (460, "upload.checksum")
        assert answer.json()["file"] == "smile.obj"
        assert answer.json()["expected"] == SHA256
        assert http.head(location).status_code == 404
    assert not list(settings.uploads.iterdir())


@pytest.mark.parametrize(
    ("headers", "status", "code"),
    [
        ({"Upload-Length": "10000001"}, 413, "upload.too_large"),
        ({"Upload-Length": "0"}, 422, "upload.empty"),
        ({"Upload-Metadata": "filename " + "Li4vc2VjcmV0"}, 400, "upload.filename"),
        ({"Upload-Metadata": "filename ?"}, 400, "upload.metadata"),
        ({"Upload-Metadata": "sha256 YWJj"}, 400, "upload.filename"),
        ({"Tus-Resumable": "0.2.2"}, 412, "upload.version"),
    ],
)
def test_uploads_that_can_not_be(
    settings: Settings, headers: dict[str, str], status: int, code: str
) -> None:
    good = {"Upload-Length": "10", "Upload-Metadata": "filename YS5vYmo="}
    with served(settings) as studio:
        answer = studio.http.post("/v1/uploads", headers=good | headers)
    assert (answer.status_code, answer.json()["code"]) == (status, code)


@pytest.mark.telling
def test_two_writers_never_mix(settings: Settings) -> None:
    """Both send the whole file from offset 0 at once, in many small pieces."""
    answers: list[httpx.Response] = []
    with served(settings) as studio:
        http = studio.http
        location = studio.start_upload("smile.obj", len(SCAN), SHA256)
        ready = threading.Barrier(2)

        def send() -> None:
            ready.wait()
            pieces = (SCAN[i : i + 10_000] for i in range(0, len(SCAN), 10_000))
            headers = {"Upload-Offset": "0", "Content-Type": OFFSET_STREAM}
            answers.append(http.patch(location, content=pieces, headers=headers))

        writers = [threading.Thread(target=send) for _ in range(2)]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        assert sorted(answer.status_code for answer in answers)[0] == 204
        assert max(answer.status_code for answer in answers) in (409, 423)
        assert studio.get(location)["sha256"] == SHA256


def test_a_broken_connection_loses_nothing_that_arrived(settings: Settings) -> None:
    config = uvicorn.Config(create_app(settings), port=0, log_config=None)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        port = server.servers[0].sockets[0].getsockname()[1]
        with httpx.Client(base_url=f"http://127.0.0.1:{port}") as http:
            studio = Studio(http, settings.admin_key.read_text())
            location = studio.start_upload("smile.obj", len(SCAN), SHA256)
            with socket.create_connection(("127.0.0.1", port)) as connection:
                head = (
                    f"PATCH {location} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpload-Offset: 0\r\n"
                    f"Authorization: Bearer {studio.key}\r\n"
                    f"Content-Type: {OFFSET_STREAM}\r\nContent-Length: {len(SCAN)}\r\n\r\n"
                )
                connection.sendall(head.encode() + SCAN[:12_345])
                deadline = time.monotonic() + 10
                while http.head(location).status_code != 423:
                    assert time.monotonic() < deadline
                    time.sleep(0.01)
                time.sleep(0.2)
            deadline = time.monotonic() + 5
            while http.head(location).headers.get("Upload-Offset") != "12345":
                assert time.monotonic() < deadline
            assert studio.send(location, 12_345, SCAN[12_345:]).status_code == 204
            assert studio.get(location)["sha256"] == SHA256
    finally:
        server.should_exit = True
        thread.join()


@pytest.mark.parametrize("sees_it", [True, False])
def test_asking_while_the_last_bytes_come_tells_the_end(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, sees_it: bool
) -> None:
    get = UploadService.get
    with served(settings) as studio:
        location = studio.start_upload("smile.obj", len(SCAN), SHA256)
        looks = 0

        def look(service: UploadService, upload_id: str) -> Upload:
            nonlocal looks
            looks += 1
            before = get(service, upload_id)
            if looks != (2 if sees_it else 1):
                return before
            assert studio.send(location, 0, SCAN).status_code == 204
            return get(service, upload_id) if sees_it else before

        monkeypatch.setattr(UploadService, "get", look)
        asked = studio.http.head(location)
        assert (asked.status_code, asked.headers["Upload-Offset"]) == (200, str(len(SCAN)))


@pytest.mark.telling
def test_giving_up_removes_the_bytes(settings: Settings) -> None:
    with served(settings) as studio:
        http = studio.http
        location = studio.start_upload("smile.obj", len(SCAN))
        studio.send(location, 0, SCAN[:1000])
        assert http.delete(location).status_code == 204
        assert http.head(location).status_code == 404
    assert not list(settings.uploads.iterdir())


def test_bytes_of_uploads_that_are_over_go(settings: Settings) -> None:
    settings = settings.model_copy(update={"garbage_age": 0.2})
    with served(settings) as studio:
        location = studio.start_upload("smile.obj", 10)
        studio.send(location, 0, b"v 0")
        part = settings.uploads / location.rsplit("/", 1)[1]
        orphan = settings.uploads / str(uuid.uuid4())
        stranger = settings.uploads / "a-note.txt"
        for path in (orphan, stranger):
            path.write_bytes(b"v 0 0 0")
        for path in (part, orphan, stranger):
            os.utime(path, (0, 0))
        eventually(lambda: not orphan.exists())
        assert part.exists()
        assert stranger.exists()
        assert studio.send(location, 3, b" 0 0 1\n").status_code == 204
