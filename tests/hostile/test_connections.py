"""No tenant goes without a connection, whatever others hold: 30 where 20 fit."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.access import bootstrap
from service.app import create_app
from service.http.slots import ConnectionSlots
from service.settings import Settings
from tests.hostile.edge import serving, until_closed

MOST = 20


@pytest.fixture
def slots() -> ConnectionSlots[Any]:
    return ConnectionSlots(MOST, 8, 12)


@pytest.fixture
def keys() -> dict[str, str]:
    """The keys of two tenants, once the service is there."""
    return {}


@pytest.fixture
def port(tmp_path: Path, slots: ConnectionSlots[Any], keys: dict[str, str]) -> Iterator[int]:
    settings = Settings(data_dir=tmp_path)
    app = create_app(settings)
    with serving(app, 30, slots, limit_concurrency=MOST + 1) as port:
        bootstrap.add_tenant(app.state.store, app.state.keyring, "other", tmp_path / "other.key")
        keys["default"] = settings.admin_key.read_text()
        keys["other"] = (tmp_path / "other.key").read_text()
        yield port


def _client(port: int, key: str) -> httpx.Client:
    headers = {"Authorization": f"Bearer {key}"}
    return httpx.Client(
        base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=20, trust_env=False
    )


def _with_key(port: int, key: str, path: str = "/v1/me") -> socket.socket:
    """Return a connection that has shown a key, and stays."""
    head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {key}\r\n\r\n"
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    connection.sendall(head.encode())
    assert connection.recv(4096).startswith(b"HTTP/1.1 200")
    return connection


def test_a_tenant_s_idle_connections_take_none_of_another_s(
    port: int, keys: dict[str, str], slots: ConnectionSlots[Any]
) -> None:
    with _client(port, keys["other"]) as other:
        assert other.get("/v1/me").is_success
        idle = [_with_key(port, keys["default"]) for _ in range(30)]
        assert other.get("/v1/me").is_success  # its connection is there still
        for connection in idle[:18]:  # the longest idle of their own tenant
            until_closed(connection)
        for _ in range(5):
            with _client(port, keys["other"]) as fresh:
                assert fresh.get("/v1/me").json()["tenant"] != "default"
    for connection in idle:
        connection.close()


def test_silent_connections_give_way_and_a_customer_stays(
    port: int, keys: dict[str, str], slots: ConnectionSlots[Any]
) -> None:
    with _client(port, keys["default"]) as customer:
        assert customer.get("/v1/me").is_success
        silent = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(30)]
        for connection in silent[:22]:
            until_closed(connection)
        assert customer.get("/v1/me").is_success
        assert slots.anonymous == 8
        with _client(port, keys["default"]) as fresh:
            assert fresh.get("/v1/me").is_success
    for connection in silent:
        connection.close()


def test_who_sends_a_body_without_a_key_is_told_so_at_once(port: int) -> None:
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 60000\r\n\r\n{"
    with socket.create_connection(("127.0.0.1", port), timeout=20) as connection:
        connection.sendall(head)
        answer, seconds = until_closed(connection)
    assert answer.startswith(b"HTTP/1.1 401")
    assert seconds < 10


def test_a_request_that_is_being_received_is_not_idle(port: int, keys: dict[str, str]) -> None:
    receiving = _with_key(port, keys["default"])
    body = b'{"name": "Alex"}'
    head = (
        "POST /v1/subjects HTTP/1.1",
        "Host: 127.0.0.1",
        f"Authorization: Bearer {keys['default']}",
        "Content-Type: application/json",
        f"Content-Length: {len(body)}",
        "Connection: close",
    )
    receiving.sendall("\r\n".join((*head, "", "")).encode() + body[:5])
    time.sleep(0.2)  # until the service has the head
    idle = [_with_key(port, keys["default"]) for _ in range(12)]  # as many as a tenant may have
    until_closed(idle[0])
    receiving.sendall(body[5:])
    assert b"HTTP/1.1 201" in until_closed(receiving)[0]
    for connection in (receiving, *idle):
        connection.close()
