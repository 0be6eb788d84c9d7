"""Clients that keep the service waiting, over real connections."""

from __future__ import annotations

import json
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from service.app import create_app
from service.settings import Settings
from tests.campaigns.slow_clients.crowd import forged_key
from tests.certificate import self_signed
from tests.hostile.edge import connected, serving, until_closed
from tests.service_client import eventually

PATIENCE = 0.6
HEAD = b"POST /v1/subjects HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"


@pytest.fixture(scope="module")
def port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    folder: Path = tmp_path_factory.mktemp("slow")
    settings = Settings(data_dir=folder, receive_timeout=PATIENCE)
    with serving(create_app(settings), PATIENCE) as port:
        yield port


def _drip(connection: socket.socket, text: bytes, pause: float = 0.05) -> None:
    """Send a byte at a time until the server has had enough."""
    try:
        for i in range(len(text)):
            connection.sendall(text[i : i + 1])
            time.sleep(pause)
    except OSError:
        pass


def _answer(raw: bytes) -> tuple[int, dict[str, object]]:
    head, _, body = raw.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


def test_a_connection_that_says_nothing_is_closed(port: int) -> None:
    with connected(port) as connection:
        received, seconds = until_closed(connection)
    assert received == b""
    assert PATIENCE - 0.1 < seconds < PATIENCE + 2


def test_headers_must_arrive_in_time_however_busily_they_drip(port: int) -> None:
    started = time.monotonic()
    with connected(port) as connection:
        _drip(connection, b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: y\r\n" * 20)
        received, _ = until_closed(connection)
    assert time.monotonic() - started < PATIENCE + 3
    status, problem = _answer(received)
    assert (status, problem["code"]) == (408, "request.timeout")


def test_the_second_request_of_a_connection_has_a_deadline_too(port: int) -> None:
    request = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    with connected(port) as connection:
        connection.sendall(request)
        assert connection.recv(65_536).startswith(b"HTTP/1.1 200")
        _drip(connection, request[:-2] + b"X: y\r\n" * 20)
        received, _ = until_closed(connection)
    assert b" 408 " in received.split(b"\r\n")[0]


def test_a_body_has_one_deadline_for_the_whole_of_it(port: int) -> None:
    started = time.monotonic()
    with connected(port) as connection:
        connection.sendall(HEAD + forged_key() + b"Content-Length: 1000\r\n\r\n")
        _drip(connection, b"{" + b" " * 40)
        received, _ = until_closed(connection)
    assert time.monotonic() - started < PATIENCE + 3
    status, problem = _answer(received)
    assert (status, problem["code"]) == (408, "request.timeout")


def test_after_a_refusal_nobody_may_go_on_sending(port: int) -> None:
    head = HEAD.replace(b"127.0.0.1", b"evil.example") + b"Content-Length: 1000000\r\n\r\n"
    with connected(port) as connection:
        connection.sendall(head)
        started = time.monotonic()
        _drip(connection, b"x" * 200)
        until_closed(connection)
    assert time.monotonic() - started < PATIENCE + 3


BLOCK = 64 * 1024
BLOCKS = 1000


class _Downloads:
    """An application that sends 64 MB, and knows how many blocks it made and how many it ended."""

    made = ended = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        try:
            await StreamingResponse(self._blocks())(scope, receive, send)
        finally:
            self.ended += 1

    def _blocks(self) -> Iterator[bytes]:
        for _ in range(BLOCKS):
            self.made += 1
            yield bytes(BLOCK)


def test_who_does_not_read_is_cut_off_and_holds_little() -> None:
    app = _Downloads()
    with serving(app, PATIENCE) as port, connected(port) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        eventually(lambda: app.ended == 1, seconds=2 * PATIENCE + 2)
        received, _ = until_closed(connection)
    assert app.made * BLOCK < 16e6  # what the kernel takes by itself, and a few blocks
    assert len(received) < app.made * BLOCK


def test_who_reads_slowly_gets_all_of_it() -> None:
    app = _Downloads()
    patience = 2.0  # a busy machine may hold this client up for a second by itself
    received = 0
    started = time.monotonic()
    with serving(app, patience) as port, connected(port) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
        while content := connection.recv(4 * 1024**2):
            received += len(content)
            time.sleep(patience / 8)
    assert received > BLOCKS * BLOCK
    assert time.monotonic() - started > 1.5 * patience


@pytest.mark.parametrize("tls", [False, True])
def test_who_reads_at_little_more_than_the_least_rate_is_not_cut_off(
    tmp_path: Path, tls: bool
) -> None:
    patience = 1.5
    rate = (8 if tls else 4) * 65_536 / patience
    key, certificate = self_signed(tmp_path, "IP:127.0.0.1")
    files = {"ssl_keyfile": str(key), "ssl_certfile": str(certificate)} if tls else {}
    with serving(_Downloads(), patience, **files) as port, socket.socket() as plain:
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)  # takes little ahead
        plain.settimeout(10)
        plain.connect(("127.0.0.1", port))
        context = ssl.create_default_context(cafile=str(certificate))
        with context.wrap_socket(plain, server_hostname="127.0.0.1") if tls else plain as reader:
            reader.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n")
            received = 0
            started = time.monotonic()
            while (seconds := time.monotonic() - started) < 3 * patience:
                if received < rate * seconds:
                    content = reader.recv(4096)
                    assert content
                    received += len(content)
                else:
                    time.sleep(0.01)


def test_many_slow_ones_hold_up_nobody(port: int) -> None:
    slow = [socket.create_connection(("127.0.0.1", port)) for _ in range(200)]
    try:
        for connection in slow:
            connection.sendall(b"GET / HTTP/1.1\r\n")
        with connected(port) as connection:
            started = time.monotonic()
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert connection.recv(65_536).startswith(b"HTTP/1.1 200")
            assert time.monotonic() - started < 5
        assert all(b" 408 " in until_closed(connection)[0] for connection in slow)
    finally:
        for connection in slow:
            connection.close()


@pytest.mark.parametrize(
    "request_line",
    [
        b"NONSENSE\r\n\r\n",
        b"GET /\x00 HTTP/1.1\r\nHost: a\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        HEAD + b"Content-Length: -1\r\n\r\n",
        HEAD + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\nhello!",
        HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n",
        b"GET / HTTP/1.1\r\n" + b"X: " + b"y" * 100_000,
    ],
)
def test_what_is_not_http_is_told_so(port: int, request_line: bytes) -> None:
    with connected(port) as connection:
        connection.sendall(request_line)
        received, _ = until_closed(connection)
    status, problem = _answer(received)
    assert (status, problem["code"]) == (400, "request.malformed")


def test_two_lengths_never_make_two_requests(port: int) -> None:
    """Content-Length beside chunks is how requests are smuggled past a proxy."""
    smuggled = b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    head = HEAD + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n"
    with connected(port) as connection:
        connection.sendall(head + b"0\r\n\r\n" + smuggled)
        received, _ = until_closed(connection)
    assert received.startswith(b"HTTP/1.1 400")
    assert received.count(b"HTTP/1.1 ") == 1
