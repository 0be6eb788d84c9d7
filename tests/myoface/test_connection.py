"""What the client does about a line that breaks and a service that asks to come back later."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from myoface.client import Client, ClientOptions
from myoface.client.retry import IN_FLIGHT
from myoface.errors import ApiError
from myoface.resources import Artifact

SUBJECT = {"id": "1", "name": "Ada"}
RATE = {"code": "request.rate"}
QUOTA = {"code": "quota.queued"}

Answer = httpx.Response | Exception


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    waited: list[float] = []
    monkeypatch.setattr("time.sleep", waited.append)
    return waited


def service(
    *answers: Answer | Callable[[httpx.Request], Answer],
) -> tuple[Client, list[httpx.Request]]:
    """Return a client of a service that answers so, one after the other, and what it was asked."""
    waiting = list(answers)
    asked = []

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request)
        given = waiting.pop(0)
        if isinstance(given, Exception):
            if isinstance(given, httpx.TransportError):
                given.request = request
            raise given
        assert isinstance(given, httpx.Response)
        return given

    client = Client("http://service", "myo_key", options=ClientOptions(first_pause_s=0.001))
    client.http = httpx.Client(base_url="http://service", transport=httpx.MockTransport(answer))
    return client, asked


def refusal(status: int, body: dict[str, str], **headers: str) -> httpx.Response:
    return httpx.Response(status, json=body, headers=headers)


def test_a_service_that_is_not_ready_is_asked_again() -> None:
    client, asked = service(refusal(503, {"code": "x"}), httpx.Response(200, json=SUBJECT))
    assert client.subject("1").name == "Ada"
    assert len(asked) == 2


def test_a_refusal_is_final() -> None:
    client, _ = service(refusal(404, {"code": "test.404"}))
    with pytest.raises(ApiError) as caught:
        client.subject("1")
    assert caught.value.code == "test.404"


def test_who_asks_too_fast_waits_as_long_as_the_service_says(pauses: list[float]) -> None:
    too_fast = refusal(429, RATE, **{"Retry-After": "7"})
    client, asked = service(too_fast, httpx.Response(200, json={"state": "canceled"}))
    with pytest.raises(ApiError, match=r"client\.answer"):  # no job: the request went through
        client.cancel("1", "why")
    assert pauses == [7.0]
    assert len(asked) == 2


def test_a_quota_is_not_waited_for(pauses: list[float]) -> None:
    client, _ = service(refusal(429, QUOTA, **{"Retry-After": "60"}))
    with pytest.raises(ApiError, match=r"quota\.queued"):
        client.submit("build_model", "1")
    assert pauses == []


def test_what_is_made_over_a_breaking_line_is_made_under_one_key() -> None:
    lost = httpx.ReadError("the line broke")
    client, asked = service(
        lost, refusal(409, {"code": IN_FLIGHT}), httpx.Response(201, json=SUBJECT)
    )
    client.create_subject("Ada")
    keys = {request.headers["Idempotency-Key"] for request in asked}
    assert (len(asked), len(keys)) == (3, 1)


def test_nobody_there_is_said_at_once() -> None:
    client, asked = service(httpx.ConnectError("refused"))
    with pytest.raises(ApiError) as caught:
        client.subjects()
    assert caught.value.code == "client.unreachable"
    assert len(asked) == 1


def test_a_job_is_waited_for_while_its_service_is_restarted(pauses: list[float]) -> None:
    job = {"id": "1", "subject_id": "2", "kind": "build_model", "state": "succeeded", "attempt": 1}
    away = [refusal(502, {"code": "x"}) for _ in range(ClientOptions().attempts + 1)]
    client, asked = service(*away, httpx.Response(200, json=job))
    assert client.wait("1").state == "succeeded"
    assert len(pauses) == len(away) == len(asked) - 1


def test_a_service_that_had_no_time_to_write_is_asked_again(pauses: list[float]) -> None:
    gone = httpx.Response(202, headers={"Location": "/v1/jobs/1"})
    client, asked = service(refusal(503, {"code": "database.busy"}), gone)
    assert client.delete_subject("1")
    assert len(asked) == 2
    assert len(pauses) == 1


def test_an_upload_that_never_goes_on_is_given_up(tmp_path: Path, pauses: list[float]) -> None:
    file = tmp_path / "scan.obj"
    file.write_text("v 0 0 0\n")

    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "POST":
            return httpx.Response(201, headers={"Location": "/v1/uploads/1"})
        if request.method == "HEAD":
            return httpx.Response(200, headers={"Upload-Offset": "0"})
        return refusal(503, {"code": "storage.full"})

    client, _ = service()
    client.http = httpx.Client(base_url="http://service", transport=httpx.MockTransport(answer))
    with pytest.raises(ApiError, match=r"storage\.full"):
        client.upload(file)
    assert len(pauses) == ClientOptions().attempts - 1


@pytest.mark.parametrize("key", ["myo_a\nb", "myo_ä", "Bearer myo_a"])
def test_what_is_no_key_is_told_at_once(key: str) -> None:
    with pytest.raises(ApiError, match=r"client\.key"):
        Client("http://service", key)


def test_a_key_may_end_in_a_new_line() -> None:
    assert Client("http://service", "myo_a\n").http.headers["Authorization"] == "Bearer myo_a"


def test_kinds_have_an_old_name_for_one_release() -> None:
    kind = {"kind": "edit", "title": "Edit", "description": "Change.", "options": {}}
    page = httpx.Response(200, json={"items": [kind]})
    client, asked = service(page, httpx.Response(200, json={"items": [kind]}))
    with pytest.warns(DeprecationWarning, match="kinds"):
        old = client.solvers()
    assert old == client.kinds()
    assert [request.url.path for request in asked] == ["/v1/kinds", "/v1/kinds"]


@pytest.mark.parametrize(("header", "pause"), [("5", 5.0), ("3600", 120.0), (None, 2.0)])
def test_a_stream_too_many_is_asked_for_when_the_service_says(
    pauses: list[float], header: str | None, pause: float
) -> None:
    job = {"id": "1", "subject_id": "2", "kind": "build_model", "state": "running", "attempt": 1}
    headers = {} if header is None else {"Retry-After": header}
    client, asked = service(
        httpx.Response(200, json=job),
        refusal(429, {"code": "stream.too_many"}, **headers),
        httpx.Response(200, json=job | {"state": "succeeded"}),
    )
    assert client.wait("1").state == "succeeded"
    assert pauses == [pause]
    assert len(asked) == 3


LOGIN = httpx.Response(200, text="<html>Sign in</html>", headers={"Content-Type": "text/html"})
ID = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"


@pytest.mark.parametrize(
    ("answer", "call", "words"),
    [
        (
            httpx.Response(308, headers={"Location": "https://faces.studio/"}),
            lambda client: client.subjects(),
            "308, to https://faces.studio/",
        ),
        (LOGIN, lambda client: client.subject(ID), "text/html and not JSON"),
        (LOGIN, lambda client: client.signed_url(ID), "text/html and not JSON"),
        (httpx.Response(200, json=[]), lambda client: client.subjects(), "Page"),
        (httpx.Response(200, json={}), lambda client: client.subjects(), "Page.items"),
        (httpx.Response(200, json={}), lambda client: list(client.log(ID)), "LogPage.lines"),
        (httpx.Response(200, json={}), lambda client: client.signed_url(ID), "SignedUrl.url"),
        (httpx.Response(204), lambda client: client.delete_subject(ID), "without a Location"),
    ],
)
def test_an_answer_of_another_server_is_told(
    answer: httpx.Response, call: Callable[[Client], object], words: str
) -> None:
    client, asked = service(answer)
    with pytest.raises(ApiError, match=words) as caught:
        call(client)
    assert caught.value.code == "client.answer"
    assert len(asked) == 1


def test_a_login_page_is_not_fetched_for_ever(tmp_path: Path) -> None:
    wanted = Artifact(id=ID, name="rig.glb", size=1000, sha256="0" * 64, media_type="x")
    client, asked = service(LOGIN, LOGIN)
    with pytest.raises(ApiError, match="not the file"):
        client.download(wanted, tmp_path / "rig.glb")
    assert list(tmp_path.iterdir()) == []
    assert len(asked) == 2


@pytest.mark.parametrize(
    "address",
    ["", "faces.studio", "127.0.0.1:8765", "ftp://x", "http://[::1", "http://h:port", "http://"],
)
def test_what_is_no_address_is_told_at_once(address: str) -> None:
    with pytest.raises(ApiError, match="no address of a service") as caught:
        Client(address)
    assert caught.value.code == "client.address"
