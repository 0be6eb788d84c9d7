"""Strangers take no seat of a customer: 30 that are silent, where 20 fit."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.app import create_app
from service.http.seats import Seats
from service.settings import Settings
from tests.hostile.edge import serving, until_closed


@pytest.fixture
def seats() -> Seats[Any]:
    return Seats(20, 8)


@pytest.fixture
def customer(tmp_path: Path, seats: Seats[Any]) -> Iterator[httpx.Client]:
    settings = Settings(data_dir=tmp_path)
    with serving(create_app(settings), 30, seats) as port:
        headers = {"Authorization": f"Bearer {settings.admin_key.read_text()}"}
        url = f"http://127.0.0.1:{port}"
        with httpx.Client(base_url=url, headers=headers, timeout=20, trust_env=False) as http:
            yield http


def test_silent_strangers_give_way_and_a_customer_stays(
    customer: httpx.Client, seats: Seats[Any]
) -> None:
    assert customer.get("/v1/me").is_success
    port = customer.base_url.port
    strangers = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(30)]
    for stranger in strangers[:22]:
        until_closed(stranger)
    assert customer.get("/v1/me").is_success
    assert seats.strangers == 8
    fresh = httpx.get(
        f"http://127.0.0.1:{port}/v1/me",
        headers=dict(customer.headers),
        trust_env=False,
        timeout=20,
    )
    assert fresh.is_success
    for stranger in strangers:
        stranger.close()


def test_who_sends_a_body_without_a_key_is_told_so_at_once(customer: httpx.Client) -> None:
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 60000\r\n\r\n{"
    with socket.create_connection(("127.0.0.1", customer.base_url.port), timeout=20) as stranger:
        stranger.sendall(head)
        answer, seconds = until_closed(stranger)
    assert answer.startswith(b"HTTP/1.1 401")
    assert seconds < 10
