"""A customer names the receiver: no name, number or trick leads into the network of the service."""

from __future__ import annotations

import ipaddress
import re
import socket
import ssl
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from service.outbound import MOST_ANSWER, Refused, Sender, Unreachable, is_allowed
from tests.certificate import self_signed
from tests.receiver import LOOPBACK, Receiver, receiving

PUBLIC = "93.184.216.34"  # is only ever judged, never called


@pytest.mark.parametrize(
    "text",
    [
        "127.0.0.1",
        "127.9.9.9",
        "0.0.0.0",
        "10.0.0.1",
        "172.16.0.1",
        "192.168.1.1",
        "169.254.169.254",
        "100.64.0.1",
        "192.0.0.8",
        "192.0.2.1",
        "198.18.0.1",
        "203.0.113.7",
        "192.88.99.1",
        "224.0.0.1",
        "239.255.255.250",
        "240.0.0.1",
        "255.255.255.255",
        "::",
        "::1",
        "::ffff:127.0.0.1",
        "::ffff:169.254.169.254",
        "::127.0.0.1",
        "64:ff9b::10.0.0.1",
        "64:ff9b::7f00:1",
        "64:ff9b:1::1",
        "2002:7f00:1::1",
        "2002:a9fe:a9fe::",
        "2001::1",
        "2001:db8::1",
        "3fff::1",
        "fc00::1",
        "fd00:ec2::254",
        "fe80::1",
        "fec0::1",
        "ff02::1",
        "100::1",
        "5f00::1",
    ],
)
def test_addresses_that_are_not_public(text: str) -> None:
    assert not is_allowed(ipaddress.ip_address(text))


@pytest.mark.parametrize(
    "text",
    [PUBLIC, "8.8.8.8", "2606:4700::1", "::ffff:8.8.8.8", "64:ff9b::808:808", "2002:808:808::1"],
)
def test_public_addresses(text: str) -> None:
    assert is_allowed(ipaddress.ip_address(text))


def test_every_private_ipv4_block_is_refused_to_its_edges() -> None:
    blocks = ["0.0.0.0/8", "10.0.0.0/8", "100.64.0.0/10", "127.0.0.0/8", "169.254.0.0/16"]
    blocks += ["172.16.0.0/12", "192.168.0.0/16", "198.18.0.0/15", "224.0.0.0/4", "240.0.0.0/4"]
    for block in map(ipaddress.IPv4Network, blocks):
        for edge in (block[0], block[-1]):
            for shape in (f"{edge}", f"::ffff:{edge}", f"64:ff9b::{edge}"):
                assert not is_allowed(ipaddress.ip_address(shape)), shape


def _names(**hosts: Sequence[str]) -> Callable[[str, int], Sequence[str]]:
    def resolver(host: str, _port: int) -> Sequence[str]:
        if host not in hosts:
            raise socket.gaierror(socket.EAI_NONAME, "unknown")
        return hosts[host]

    return resolver


def test_a_body_arrives_whole_with_its_headers_and_the_name_as_host() -> None:
    resolver = _names(receiver=["127.0.0.1"])
    with receiving() as (port, got):
        sender = Sender(5, LOOPBACK, resolver)
        answer = sender.post(
            f"http://receiver:{port}/in?a=1",
            b'{"x": 1}',
            {"webhook-id": "msg_1", "User-Agent": "M"},
        )
    assert answer.status == 204
    [(path, headers, body)] = got
    assert (path, body) == ("/in?a=1", b'{"x": 1}')
    assert (headers["host"], headers["webhook-id"]) == (f"receiver:{port}", "msg_1")


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "localhost",
        "127.1",
        "0x7f000001",
        "2130706433",
        "0177.0.0.1",
        "[::1]",
        "0",
        "[::ffff:127.0.0.1]",
        "[::ffff:7f00:1]",
    ],
)
def test_every_way_to_write_this_machine_is_refused(host: str) -> None:
    with receiving() as (port, got):
        with pytest.raises((Refused, Unreachable)) as caught:
            Sender(5).post(f"http://{host}:{port}/", b"{}", {})
        assert caught.value.code in ("address.private", "address.unknown")
    assert got == []


def test_one_private_address_among_public_ones_refuses_the_name() -> None:
    sender = Sender(5, (), _names(mixed=[PUBLIC, "10.0.0.1"]))
    with pytest.raises(Refused, match="not a public address"):
        sender.post("https://mixed/", b"{}", {})


def test_where_a_name_leads_is_told_to_the_operator_alone() -> None:
    sender = Sender(5, (), _names(inner=[PUBLIC, "10.7.7.1"]))
    with capture_logs() as logs, pytest.raises(Refused) as caught:
        sender.post("https://inner/", b"{}", {})
    assert "MYOFACE_WEBHOOK_ALLOW" in str(caught.value)
    assert not re.search("[0-9]", str(caught.value))
    assert [(each["host"], each["network"]) for each in logs] == [("inner", "10.7.7.0/24")]


@pytest.mark.parametrize(
    ("host", "example"),
    [
        ("10.7.7.1", "10.7.7.0/24"),
        ("[::ffff:10.7.7.1]", "10.7.7.0/24"),
        ("[fd00:1::1]", "fd00:1::/64"),
        ("127.0.0.1", None),
        ("[::1]", None),
        ("169.254.169.254", None),
        ("[fe80::1]", None),
    ],
)
def test_an_address_that_was_typed_is_refused_with_an_example(
    host: str, example: str | None
) -> None:
    with pytest.raises(Refused) as caught:
        Sender(5).check(f"https://{host}/")
    end = f"""MYOFACE_WEBHOOK_ALLOW, such as '["{example}"]'""" if example else "_ALLOW"
    assert str(caught.value).endswith(end)


def test_a_name_that_changes_after_the_check_is_not_asked_again() -> None:
    asked: list[str] = []

    def rebinding(host: str, _port: int) -> Sequence[str]:
        asked.append(host)
        return ["127.0.0.1"] if len(asked) == 1 else ["10.255.255.1"]

    with receiving() as (port, got):
        assert Sender(5, LOOPBACK, rebinding).post(f"http://a:{port}/", b"{}", {}).status == 204
    assert (asked, len(got)) == (["a"], 1)


def test_ports_of_other_services_are_refused() -> None:
    sender = Sender(5, (), _names(a=[PUBLIC]))
    for port in (22, 25, 6379, 5432, 8765):
        with pytest.raises(Refused, match="MYOFACE_WEBHOOK_ALLOW") as caught:
            sender.post(f"http://a:{port}/", b"{}", {})
        assert caught.value.code == "address.port"
        with pytest.raises(Refused) as caught:
            sender.check(f"http://a:{port}/")  # as early as that
        assert caught.value.code == "address.port"
    sender.check("http://a:8443/")
    Sender(5, LOOPBACK, _names()).check("http://a:9000/")  # it may lead there, where any port is


@pytest.mark.parametrize(
    "url",
    [
        "file:///etc/passwd",
        "gopher://a/",
        "ftp://a/",
        "//a/",
        "a",
        "",
        "http://",
        "http:///x",
        "http://user:secret@a/",
        "http://a@b/",
        "http://a/\r\nX: y",
        "http://a b/",
        "http://ä/",
        "http://a:99999/",
        "http://a:b/",
        "http://[::1/",
        "http://" + "a" * 2000,
    ],
)
def test_what_is_no_url_to_send_to(url: str) -> None:
    with pytest.raises(Refused) as caught:
        Sender(5, LOOPBACK, _names(a=["127.0.0.1"])).post(url, b"{}", {})
    assert caught.value.code == "address.invalid"


@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("7", 7.0),
        ("Wed, 21 Oct 2015 07:28:00 GMT", 0.0),
        ("Fri, 99 Oct 9999999999 00:00:00 GMT", None),
        ("-1", None),
        ("1e9", None),
        ("9" * 40, None),
        ("soon", None),
    ],
)
def test_when_to_come_back_is_read_strictly(text: str, seconds: float | None) -> None:
    def busy(receiver: Receiver) -> None:
        receiver.send_response(429)
        receiver.send_header("Retry-After", text)
        receiver.end_headers()

    with receiving(busy) as (port, _):
        answer = Sender(5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {})
    assert answer.retry_after == seconds


def test_a_redirect_is_an_answer_and_is_not_followed() -> None:
    with receiving() as (inner, reached):

        def redirect(receiver: Receiver) -> None:
            receiver.send_response(307)
            receiver.send_header("Location", f"http://127.0.0.1:{inner}/")
            receiver.end_headers()

        with receiving(redirect) as (port, _):
            answer = Sender(5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {})
    assert (answer.status, reached) == (307, [])


def test_the_environments_proxy_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    with receiving() as (proxy, carried), receiving() as (port, got):
        for name in ("http_proxy", "HTTP_PROXY", "ALL_PROXY", "https_proxy"):
            monkeypatch.setenv(name, f"http://127.0.0.1:{proxy}")
        assert Sender(5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {}).status == 204
    assert (carried, len(got)) == ([], 1)


def _endless(receiver: Receiver) -> None:
    receiver.send_response(200)
    receiver.end_headers()
    try:
        while True:
            receiver.wfile.write(b"x" * 65_536)
    except OSError:
        pass


def test_an_endless_answer_is_cut_off() -> None:
    with receiving(_endless) as (port, _):
        started = time.monotonic()
        answer = Sender(5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {})
    assert len(answer.body) == MOST_ANSWER
    assert time.monotonic() - started < 4


def _drip_head(receiver: Receiver) -> None:
    _drip(receiver, b"HTTP/1.1 200 OK\r\nX: " + b"y" * 100)


def _drip_body(receiver: Receiver) -> None:
    receiver.send_response(200)
    receiver.end_headers()
    _drip(receiver, b"z" * 100)


def _drip(receiver: Receiver, text: bytes) -> None:
    try:
        for i in range(len(text)):
            receiver.wfile.write(text[i : i + 1])
            receiver.wfile.flush()
            time.sleep(0.05)
    except OSError:
        pass


def _silence(_receiver: Receiver) -> None:
    time.sleep(5)


@pytest.mark.parametrize("script", [_drip_head, _drip_body, _silence])
def test_the_time_limit_is_for_everything_together(script: Callable[[Receiver], None]) -> None:
    with receiving(script) as (port, _):
        started = time.monotonic()
        with pytest.raises(Unreachable) as caught:
            Sender(0.5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {})
        assert caught.value.code == "timeout"
        assert 0.4 < time.monotonic() - started < 3


def test_a_slow_resolver_counts_too() -> None:
    def slow(_host: str, _port: int) -> Sequence[str]:
        time.sleep(5)
        return [PUBLIC]

    started = time.monotonic()
    with pytest.raises(Unreachable) as caught:
        Sender(0.3, (), slow).post("https://a/", b"{}", {})
    assert (caught.value.code, time.monotonic() - started < 3) == ("timeout", True)


def test_nobody_listens_or_no_such_name() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        with pytest.raises(Unreachable) as caught:
            Sender(5, LOOPBACK).post(f"http://127.0.0.1:{port}/", b"{}", {})
    assert caught.value.code == "connection.failed"
    with pytest.raises(Unreachable) as caught:
        Sender(5, (), _names()).post("https://nowhere/", b"{}", {})
    assert caught.value.code == "address.unknown"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return self_signed(tmp_path_factory.mktemp("tls"), "DNS:receiver.test")


def test_tls_is_checked_against_the_name_and_asks_for_it(certificate: tuple[Path, Path]) -> None:
    key, public = certificate
    asked: list[str | None] = []
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(public, key)
    server.sni_callback = lambda _socket, name, _context: asked.append(name)
    trusting = ssl.create_default_context(cafile=str(public))
    resolver = _names(**{"receiver.test": ["127.0.0.1"], "other.test": ["127.0.0.1"]})
    with receiving(tls=server) as (port, got):
        sender = Sender(5, LOOPBACK, resolver, trusting)
        assert sender.post(f"https://receiver.test:{port}/", b"{}", {}).status == 204
        assert got[0][1]["host"] == f"receiver.test:{port}"
        with pytest.raises(Unreachable) as caught:
            sender.post(f"https://other.test:{port}/", b"{}", {})
        assert caught.value.code == "connection.tls"
        with pytest.raises(Unreachable) as caught:
            Sender(5, LOOPBACK, resolver).post(f"https://receiver.test:{port}/", b"{}", {})
        assert caught.value.code == "connection.tls"
    assert asked == ["receiver.test", "other.test", "receiver.test"]
    assert len(got) == 1
