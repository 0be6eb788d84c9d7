"""A client behind a proxy: which one it takes, and what it says of one that does not work."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from myoface.client import Client
from myoface.client.proxies import BAD_PROXY, proxy_for
from myoface.errors import UNREACHABLE, ApiError

SERVICE = "http://faces.invalid"
VARIABLES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")


class Handler(BaseHTTPRequestHandler):
    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        content = b'{"items": [{"id": "1", "name": "Ada"}]}'
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def do_CONNECT(self) -> None:
        self.asked.append(self.path)
        self.send_error(407, "say who you are")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)


@pytest.fixture
def proxy() -> Iterator[str]:
    Handler.asked = []
    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_requests_go_by_the_proxy_that_is_given(proxy: str) -> None:
    with Client(SERVICE, "key", proxy=proxy) as client:
        assert client.subjects()[0].name == "Ada"
    assert Handler.asked[0].startswith(f"{SERVICE}/v1/subjects")


def test_requests_go_by_the_proxy_of_the_environment(
    proxy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HTTP_PROXY", proxy)
    with Client(SERVICE, "key") as client:
        client.subjects()
    assert len(Handler.asked) == 1


@pytest.mark.parametrize(
    ("url", "taken"),
    [
        (SERVICE, True),
        ("https://faces.invalid", True),
        ("http://lan.studio:8765", False),
        ("http://127.0.0.1:8765", False),
        ("http://localhost:8765", False),
    ],
)
def test_a_service_here_or_in_no_proxy_is_asked_itself(
    url: str, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ALL_PROXY", "http://proxy.studio:3128")
    monkeypatch.setenv("NO_PROXY", ".studio")
    assert (proxy_for(url, None) is not None) == taken


def test_a_proxy_that_is_down_is_named_without_its_password() -> None:
    with (
        Client(SERVICE, "key", proxy="http://ada:secret@127.0.0.1:9") as client,
        pytest.raises(ApiError) as caught,
    ):
        client.subjects()
    assert caught.value.code == UNREACHABLE
    assert "by the proxy http://127.0.0.1:9: " in str(caught.value)
    assert "secret" not in str(caught.value)


def test_a_proxy_that_refuses_is_asked_once(proxy: str) -> None:
    with (
        Client("https://faces.invalid", "key", proxy=proxy) as client,
        pytest.raises(ApiError, match="407") as caught,
    ):
        client.subjects()
    assert caught.value.code == BAD_PROXY
    assert len(Handler.asked) == 1


@pytest.mark.parametrize("cut", ["sec#ret", "sec/ret", "sec?ret", "1#ret", "1/ret", "1?ret"])
@pytest.mark.parametrize("scheme", ["http", "ftp"])
def test_a_password_that_ends_the_address_is_told_by_nobody(scheme: str, cut: str) -> None:
    with pytest.raises(ApiError, match="%23 %2F %3F") as caught:
        Client(SERVICE, "key", proxy=f"{scheme}://ada:{cut}@proxy.studio:3128")
    told = "".join(traceback.format_exception(caught.value)).partition("ApiError: ")[2]
    assert "ret" not in told
    assert "ada" not in told
    assert "proxy.studio:3128" in told
    assert caught.value.__cause__ is None


@pytest.mark.parametrize("address", ["ftp://proxy.studio", "http://", "socks5://p:1"])
def test_an_address_that_is_none_is_told(address: str) -> None:
    with pytest.raises(ApiError, match=r"client\.proxy"):
        Client(SERVICE, "key", proxy=address)
