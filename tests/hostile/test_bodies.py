"""Bodies that are too large, no JSON, or JSON that two parsers would read differently."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from service.http import bodies
from service.settings import Settings
from tests.service_client import served

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    folder: Path = tmp_path_factory.mktemp("bodies")
    with served(Settings(data_dir=folder)) as studio:
        yield studio.http


def _refused(answer: httpx.Response, status: int, code: str) -> None:
    assert (answer.status_code, answer.json()["code"]) == (status, code), answer.text
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    "body",
    [
        b'{"name": NaN}',
        b'{"name": "A", "x": Infinity}',
        b'{"x": -Infinity}',
        b'{"x": 1e999}',
        b'{"x": -1e999}',
        b'{"name": "A", "name": "B"}',
        b'{"a": {"b": 1, "b": 2}}',
        b'{"name": "\\u0000"}',
        b'{"\\ud800": 1}',
        b'{"name": "\\ud800"}',
        b'{"name": "\xff"}',
        b'\xef\xbb\xbf{"name": "A"}',
        '{"name": "A"}'.encode("utf-16"),
        b"[" * 33 + b"]" * 33,
        b"[" * 60_000,
        b'{"a":' * 10_000,
        b'{"x": ' + b"1" * 5000 + b"}",
        b"{",
        b'{"name": "A"} trailing',
        b"\x00",
    ],
)
@pytest.mark.parametrize("content_type", ["application/json", "application/x+json; charset=utf-8"])
def test_json_that_is_not_strict(http: httpx.Client, body: bytes, content_type: str) -> None:
    answer = http.post("/v1/subjects", content=body, headers={"Content-Type": content_type})
    _refused(answer, 422, "request.json")


def test_strict_json_is_left_alone() -> None:
    for text in ('{"a": [1, -2.5e3, null, true, "\\u00e4\\ud83d\\ude00"]}', '""', "0"):
        bodies.check_json(text.encode())
    bodies.check_json(b"[" * 32 + b"]" * 32)


def test_large_bodies_are_refused_on_every_route_but_an_uploads(http: httpx.Client) -> None:
    large = b" " * (1024**2 + 1)
    for method, path in (
        ("POST", "/v1/subjects"),
        ("PATCH", "/v1/subjects"),
        ("PATCH", "/v1/jobs/x"),
        ("PATCH", "/v1/uploads"),
        ("PATCH", "/v1/uploads/a/b"),
        ("DELETE", "/v1/uploads/x"),
        ("GET", "/healthz"),
    ):
        _refused(http.request(method, path, content=large, headers=JSON), 413, "request.too_large")


def test_a_body_of_unsaid_length_is_cut_off_at_its_limit(http: httpx.Client) -> None:
    start = b'{"name": "Alex", "external_id": "'
    end = b'"}'
    most = bodies.MOST_BYTES - len(start) - len(end)
    for more, status, code in ((0, 422, "request.invalid"), (1, 413, "request.too_large")):
        body = start + b"x" * (most + more) + end
        parts = iter([body[:50_000], body[50_000:]])
        _refused(http.post("/v1/subjects", content=parts, headers=JSON), status, code)


def test_a_foreign_page_may_read_nothing_and_order_nothing(http: httpx.Client) -> None:
    for site in ("cross-site", "same-site"):
        answer = http.post("/v1/jobs/x/cancel", headers={"Sec-Fetch-Site": site})
        _refused(answer, 403, "request.cross_site")
        assert http.get("/healthz", headers={"Sec-Fetch-Site": site}).status_code == 200
    own = http.post("/v1/nothing", headers={"Sec-Fetch-Site": "same-origin"})
    _refused(own, 404, "http.not_found")
    assert "access-control-allow-origin" not in http.get("/healthz").headers


def test_every_answer_has_the_headers_that_browsers_obey(http: httpx.Client) -> None:
    foreign = http.get("/healthz", headers={"Host": "evil.example"})
    _refused(foreign, 421, "request.host")
    for answer in (http.get("/healthz"), http.get("/nothing"), foreign):
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"
        assert answer.headers["content-security-policy"].startswith("default-src 'none'")
        assert answer.headers["x-request-id"]
