"""What the client does about a service that asks it to come back later."""

from __future__ import annotations

import httpx
import pytest

from myoface.connection import patiently
from myoface.errors import ApiError


def service(*statuses: int) -> httpx.Client:
    """Return a client of a service that answers with these statuses, one after the other."""
    waiting = list(statuses)

    def answer(_request: httpx.Request) -> httpx.Response:
        status = waiting.pop(0)
        return httpx.Response(status, json={"code": f"test.{status}"})

    return httpx.Client(base_url="http://service", transport=httpx.MockTransport(answer))


def test_a_service_that_is_not_ready_is_asked_again() -> None:
    assert patiently(service(503, 200), "GET", "/v1/jobs").status_code == 200


def test_a_refusal_is_final() -> None:
    with pytest.raises(ApiError) as caught:
        patiently(service(404, 200), "GET", "/v1/jobs")
    assert caught.value.code == "test.404"
