"""Tricks that an attacker tried and that came to nothing; each stays so."""

from __future__ import annotations

import base64
import json
import os
import signal
import socket
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest

from myoface.backup import back_up, restore
from myoface.errors import StackError
from service.access.principal import Scope
from service.app import create_app
from service.settings import Settings
from service.store.models import Tenant
from tests.hostile.edge import serving, until_closed
from tests.service_client import Studio, eventually, running, served


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("held"), max_open_uploads=500)) as studio:
        yield studio


def _in_metadata(name: bytes) -> dict[str, str]:
    metadata = f"filename {base64.b64encode(name).decode()}"
    return {"Upload-Length": "1", "Upload-Metadata": metadata}


@pytest.mark.parametrize(
    "name",
    [
        *(b"../x", b"..", b".", b"", b"/etc/passwd", b"a/b", b"a\\b", b"..\\..\\x", b"C:\\x"),
        *(b"a\0.obj", b"a\nb", b"a\rb", b"a\x1b[31m", b"a\x7f", b"\xff\xfe", b"x" * 256),
        *(each.encode() for each in ("a\u202eobj.exe", "a\u0085b", "a\u2028b", "\u2066a")),
    ],
)
def test_a_name_of_a_file_is_a_plain_one(studio: Studio, name: bytes) -> None:
    answer = studio.http.post("/v1/uploads", headers=_in_metadata(name))
    assert answer.status_code == 400
    assert answer.json()["code"] in ("upload.filename", "upload.metadata")


@pytest.mark.parametrize(
    "name", ["$(id).obj", "'; --.obj", 'a"b.obj', "%2e%2e%2fx", "~root", "-rf", "x" * 255, "a b"]
)
def test_a_name_that_means_something_to_others_means_nothing_here(
    studio: Studio, name: str
) -> None:
    made = studio.http.post("/v1/uploads", headers=_in_metadata(name.encode()))
    assert (made.status_code, made.json()["filename"]) == (201, name)
    folder = studio.http.app.state.settings.uploads  # type: ignore[attr-defined]
    assert made.json()["id"] in {path.name for path in folder.iterdir()}
    assert not [path for path in folder.rglob("*") if name in path.name]


@pytest.mark.parametrize(
    "length",
    ["-1", "1.5", "1e3", "0x10", "", "a", "1,2", "\u0661".encode(), "9" * 30, str(2**63), "- 1"],
)
def test_a_length_is_a_whole_number(studio: Studio, length: str | bytes) -> None:
    headers = {**_in_metadata(b"a.obj"), "Upload-Length": length}
    answer = studio.http.post("/v1/uploads", headers=headers)  # type: ignore[arg-type]
    assert 400 <= answer.status_code < 500, answer.text


def _signed(studio: Studio) -> tuple[str, str]:
    job = studio.submit("build_model", studio.subject())
    store = studio.http.app.state.store  # type: ignore[attr-defined]
    studio.pretend(job, {"rig.glb": store.files.put(Path(__file__)).sha256})
    [artifact] = studio.job(job)["result"]["artifacts"]
    path, _, token = studio.post(f"/v1/artifacts/{artifact['id']}/url")["url"].partition("?signed=")
    return path, token


def test_a_signed_url_opens_what_was_signed_and_by_reading_only(studio: Studio) -> None:
    path, token = _signed(studio)
    nobody = httpx.Client(transport=studio.http._transport, base_url="http://127.0.0.1")
    assert nobody.get(f"{path}?signed={token}").status_code == 200
    for tried in (
        f"{path}?signed={token.upper()}",
        f"{path}?signed={token}A",
        f"{path}?signed={token[:-1]}",
        f"{path}?signed=&signed={token}.",
        f"{path}?signed={token}&signed=x",
        f"{path}?Signed={token}",
        f"{path.upper()}?signed={token}",
        f"{path}/?signed={token}",
        f"{path}/url?signed={token}",
        f"/v1/subjects?signed={token}",
    ):
        assert nobody.get(tried).status_code in (401, 403, 404, 405), tried
    for method in ("POST", "PUT", "PATCH", "DELETE"):
        assert nobody.request(method, f"{path}?signed={token}").status_code in (401, 405), method


def test_another_tenant_signs_nothing_of_ours(studio: Studio) -> None:
    path, _ = _signed(studio)
    state = studio.http.app.state  # type: ignore[attr-defined]
    with state.store.write() as session:
        session.add(other := Tenant(name="another studio"))
        session.flush()
        _, key = state.keyring.mint(session, other.id, "all", Scope)
    asked = studio.http.post(f"{path}/url", headers={"Authorization": f"Bearer {key}"})
    assert (asked.status_code, asked.json()["code"]) == (404, "artifact.unknown")


def _at_once(count: int, ask: Callable[[int], httpx.Response]) -> Counter[int]:
    """Return the statuses of ``count`` requests that are sent in the same moment."""
    ready = threading.Barrier(count)
    statuses = Counter[int]()

    def one(number: int) -> None:
        ready.wait()
        statuses[ask(number).status_code] += 1

    threads = [threading.Thread(target=one, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert statuses.total() == count
    return statuses


def test_what_is_asked_for_many_times_at_once_is_done_once(studio: Studio) -> None:
    subject = studio.subject()
    job = str(uuid.uuid4())
    order = {"kind": "build_model", "subject_id": subject}
    put = _at_once(16, lambda _: studio.http.put(f"/v1/jobs/{job}", json=order))
    assert put == {201: 1, 200: 15}
    canceled = _at_once(16, lambda _: studio.http.post(f"/v1/jobs/{job}/cancel"))
    assert set(canceled) == {200, 409}
    assert canceled[200] == 1
    states = [data["state"] for _, kind, data in studio.events(job) if kind == "state"]
    assert states == ["queued", "canceled"]
    scans = [studio.upload(f"{number}.obj", b"v %d 0 0" % number) for number in range(12)]
    path = f"/v1/subjects/{subject}/captures"
    body = {"name": "smile", "role": "expression"}
    added = _at_once(12, lambda k: studio.http.post(path, json={**body, "upload_id": scans[k]}))
    assert added == {201: 1, 409: 11}


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with serving(create_app(Settings(data_dir=tmp_path_factory.mktemp("http"))), 5) as port:
        yield port


HOST = b"Host: 127.0.0.1\r\n"
CLOSE = b"Connection: close\r\n\r\n"


@pytest.mark.parametrize(
    ("request_", "status"),
    [
        (b"GET http://evil.example/healthz HTTP/1.1\r\nHost: evil.example\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nHost: evil.example\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1.evil.example\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1@evil.example\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nHost: evil.example:80\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nX: a\r\n" + CLOSE, 400),
        (b"GET /healthz HTTP/1.1\r\n" + HOST + HOST + CLOSE, 400),
        (b"GET /healthz HTTP/1.1\r\n" + HOST + b" evil.example\r\n" + CLOSE, 421),
        (b"GET /healthz HTTP/1.1\r\nHost : 127.0.0.1\r\n" + CLOSE, 400),
        (b"GET /v1/me HTTP/2.0\r\n" + HOST + CLOSE, 401),
        (b"CONNECT evil.example:443 HTTP/1.1\r\n" + HOST + CLOSE, 404),
        (b"GET /v1/me HTTP/1.0\r\n" + HOST + b"\r\n", 401),
        (b"GET /v1/%2e%2e/healthz HTTP/1.1\r\n" + HOST + CLOSE, 404),
        (b"GET //v1//subjects HTTP/1.1\r\n" + HOST + CLOSE, 404),
        (b"TRACE /healthz HTTP/1.1\r\n" + HOST + CLOSE, 405),
    ],
)
def test_odd_http_reaches_nothing(port: int, request_: bytes, status: int) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(request_)
        answer, _ = until_closed(connection)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert int(answer.split()[1]) == status, answer


@pytest.mark.parametrize(
    "upgrade",
    [
        b"Upgrade: h2c\r\nConnection: Upgrade, HTTP2-Settings\r\nHTTP2-Settings: AAMAAABk\r\n",
        b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n",
    ],
    ids=["h2c", "websocket"],
)
def test_no_other_protocol_is_spoken(port: int, upgrade: bytes) -> None:
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        connection.sendall(b"GET /v1/me HTTP/1.1\r\n" + HOST + upgrade + b"\r\n")
        answer = connection.recv(65_536)
    assert answer.startswith(b"HTTP/1.1 4"), answer


@pytest.mark.parametrize("member", ["dump", "files"])
def test_a_backup_names_no_file_outside_its_folder(member: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data")
    folder = tmp_path / "backup"
    with served(settings) as studio:
        studio.subject()
        back_up(settings, folder)
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    away = "../" * 20 + "etc/passwd"
    manifest[member] = away if member == "dump" else [away]
    path.write_text(json.dumps(manifest))
    fresh = Settings(data_dir=tmp_path / "fresh")
    with pytest.raises(StackError):
        restore(fresh, folder)
    assert not [each for each in fresh.data_dir.rglob("*") if each.name == "passwd"]


@pytest.mark.slow
def test_a_killed_api_is_there_again(tmp_path: Path) -> None:
    with running(tmp_path) as (stack, studio):
        job = studio.submit("build_model", studio.subject(seconds=1))
        first = stack.pid("api")
        os.kill(first, signal.SIGKILL)
        eventually(lambda: stack.pid("api") != first, seconds=20)

        def is_there() -> bool:
            try:
                return studio.http.get("/v1/me").is_success
            except httpx.TransportError:
                return False

        eventually(is_there, seconds=30)
        assert studio.finished(job)["state"] == "succeeded"
