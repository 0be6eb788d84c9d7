"""Uploads by clients that are wrong, greedy, or everywhere at once."""

from __future__ import annotations

import base64
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.app import create_app
from service.settings import Settings
from tests.hostile.edge import serving, until_closed
from tests.service_client import OFFSET_STREAM, Studio, eventually, served

SCAN = b"v 0 0 0\n" * 10_000
PATIENCE = 0.6


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    return Settings(
        data_dir=tmp_path_factory.mktemp("uploads"),
        max_open_uploads=3,
        receive_timeout=PATIENCE,
        min_upload_rate=100_000,
    )


@pytest.fixture(scope="module")
def api(settings: Settings) -> Iterator[Studio]:
    with served(settings) as studio:
        yield studio


@pytest.fixture
def studio(api: Studio, settings: Settings) -> Iterator[Studio]:
    yield api
    for part in settings.uploads.glob("*"):
        assert api.http.delete(f"/v1/uploads/{part.name}").status_code == 204


def _refused(answer: httpx.Response, status: int, code: str) -> None:
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text


@pytest.mark.parametrize(
    ("headers", "content", "code"),
    [
        ({"Upload-Defer-Length": "1"}, b"", "upload.extension"),
        ({"Upload-Concat": "partial"}, b"", "upload.extension"),
        ({"Content-Type": OFFSET_STREAM}, b"bytes", "upload.extension"),
        ({"Upload-Metadata": "filename YQ==,filename Yg=="}, b"", "upload.metadata"),
        ({"Upload-Metadata": "filename YQ==,sha256 YQ=="}, b"", "upload.metadata"),
        ({"Upload-Metadata": "filename " + "Li4="}, b"", "upload.filename"),
        ({"Upload-Metadata": "filename " + "Yi9j"}, b"", "upload.filename"),
    ],
)
def test_what_this_service_does_not_do_is_refused_not_ignored(
    studio: Studio, headers: dict[str, str], content: bytes, code: str
) -> None:
    good = {"Upload-Length": "10", "Upload-Metadata": "filename YS5vYmo="}
    _refused(studio.http.post("/v1/uploads", headers=good | headers, content=content), 400, code)


def test_a_checksum_of_another_length_is_no_checksum(studio: Studio) -> None:
    location = studio.start_upload("a.obj", len(SCAN))
    short = base64.b64encode(b"short").decode()
    answer = studio.send(location, 0, SCAN, **{"Upload-Checksum": f"sha256 {short}"})
    _refused(answer, 400, "upload.metadata")


def test_a_tenant_has_so_many_open_uploads(studio: Studio) -> None:
    locations = [studio.start_upload(f"{i}.obj", len(SCAN)) for i in range(3)]
    headers = {"Upload-Length": "1", "Upload-Metadata": "filename YQ=="}
    refused = studio.http.post("/v1/uploads", headers=headers)
    _refused(refused, 429, "upload.too_many")
    assert refused.headers["Retry-After"]
    assert studio.send(locations[0], 0, SCAN).status_code == 204  # a finished one is not open
    studio.start_upload("d.obj", 1)
    assert studio.http.delete(locations[1]).status_code == 204
    studio.start_upload("e.obj", 1)


def _is_locked(part: Path) -> bool:
    """Tell whether somebody holds a file's lock, as Linux has it; elsewhere it is said to be."""
    locks = Path("/proc/locks")
    return not locks.exists() or f":{part.stat().st_ino} " in locks.read_text()


def test_deleting_waits_for_nobody_and_tears_nothing_from_a_writer(settings: Settings) -> None:
    with (
        serving(create_app(settings), 30) as port,
        httpx.Client(base_url=f"http://127.0.0.1:{port}") as http,
    ):
        studio = Studio(http, settings.admin_key.read_text())
        location = studio.start_upload("a.obj", len(SCAN))
        head = (
            f"PATCH {location} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpload-Offset: 0\r\n"
            f"Authorization: Bearer {studio.key}\r\n"
            f"Content-Type: {OFFSET_STREAM}\r\nContent-Length: {len(SCAN)}\r\n\r\n"
        )
        with socket.create_connection(("127.0.0.1", port)) as writer:
            writer.sendall(head.encode() + SCAN[:1000])
            # a HEAD before the writer has its lock would have it in the writer's place
            eventually(lambda: any(map(_is_locked, settings.uploads.iterdir())))
            eventually(lambda: http.head(location).status_code == 423)
            _refused(http.delete(location), 423, "upload.locked")
            writer.sendall(SCAN[1000:])
            assert b" 204 " in writer.recv(65_536)
        assert studio.get(location)["state"] == "complete"
        assert http.delete(location).status_code == 204
    assert not list(settings.uploads.iterdir())


def test_bytes_that_drip_are_cut_off_and_those_that_came_count(settings: Settings) -> None:
    with (
        serving(create_app(settings), 30) as port,
        httpx.Client(base_url=f"http://127.0.0.1:{port}") as http,
    ):
        studio = Studio(http, settings.admin_key.read_text())
        location = studio.start_upload("a.obj", len(SCAN))
        head = (
            f"PATCH {location} HTTP/1.1\r\nHost: 127.0.0.1\r\nUpload-Offset: 0\r\n"
            f"Authorization: Bearer {studio.key}\r\n"
            f"Content-Type: {OFFSET_STREAM}\r\nContent-Length: {len(SCAN)}\r\n\r\n"
        )
        started = time.monotonic()
        with socket.create_connection(("127.0.0.1", port)) as writer:
            writer.sendall(head.encode())
            sent = 0
            try:
                while time.monotonic() - started < 5:
                    sent += writer.send(SCAN[sent : sent + 10])
                    time.sleep(0.05)
            except OSError:
                pass
            received, _ = until_closed(writer)
        assert time.monotonic() - started < PATIENCE + 4
        assert received == b"" or b" 408 " in received.split(b"\r\n")[0]
        eventually(lambda: http.head(location).status_code == 200)
        offset = int(http.head(location).headers["Upload-Offset"])
        assert 0 < offset <= sent
        assert studio.send(location, offset, SCAN[offset:]).status_code == 204
