"""One POST to a customer's address: checked, connected as checked, bounded in time and size.

A customer names the receiver, so without a check the service would carry requests into the
network it runs in: to cloud metadata, to its own database, to a neighbour's router.
"""

from __future__ import annotations

import ipaddress
import queue
import re
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import httpcore
import structlog

PORTS = frozenset({80, 443, 8443})
MOST_TRIED = 4
MOST_ANSWER = 64 * 1024
WRITE_SIZE = 16 * 1024
LONGEST_URL = 2000
# The setting by which an operator lets webhooks into networks of theirs
ALLOWANCE = "MYOFACE_WEBHOOK_ALLOW"
HTTP_DATE = "%a, %d %b %Y %H:%M:%S GMT"
DELTA_SECONDS = re.compile(r"[0-9]{1,9}")
_PRINTABLE = re.compile(r"[!-~]+")

log = structlog.get_logger()

Resolve = Callable[[str, int], Sequence[str]]

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")
# Never receivers, whatever this Python's `is_global` says of them.
_SPECIAL: tuple[Network, ...] = (
    ipaddress.IPv4Network("100.64.0.0/10"),  # between a provider and its customers
    ipaddress.IPv4Network("168.63.129.16/32"),  # a cloud's own platform, inside it
    ipaddress.IPv4Network("192.0.0.0/24"),  # protocol assignments
    ipaddress.IPv4Network("192.88.99.0/24"),  # relays of 6to4
    ipaddress.IPv6Network("2001::/23"),  # protocol assignments, Teredo among them
    ipaddress.IPv6Network("2001:db8::/32"),  # documentation
    ipaddress.IPv6Network("3fff::/20"),  # documentation
)


class Refused(Exception):  # noqa: N818 (it is refused, nothing has gone wrong)
    """The service will not send to this URL; ``code`` says why."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code


class Unreachable(Exception):  # noqa: N818 (as in "host unreachable")
    """The receiver could not be reached or did not answer in time; ``code`` says how."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code = code


@dataclass(frozen=True)
class Answer:
    """Answer of a receiver: status, duration in milliseconds, at most 64 KB of the body.

    ``retry_after`` is the header of that name in seconds, if it is there and can be read.
    """

    status: int
    ms: int
    body: bytes
    retry_after: float | None = None


def resolve(host: str, port: int) -> list[str]:
    """Return the addresses of ``host`` by the system's resolver."""
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(entry[4][0]) for entry in found))


def parse(url: str) -> httpcore.URL:
    """Return ``url`` if it is one that the service may send to, as far as its text tells.

    Raises
    ------
    Refused
        ``address.invalid`` if it is none: only http and https, in ASCII, without user and password.
    """
    if not _PRINTABLE.fullmatch(url) or len(url) > LONGEST_URL:
        raise Refused("address.invalid", "the URL is too long, or not plain ASCII")
    try:
        parsed = httpcore.URL(url)
    except (ValueError, UnicodeError) as error:
        raise Refused("address.invalid", "this is not a URL") from error
    if parsed.scheme not in (b"http", b"https") or not parsed.host:
        raise Refused("address.invalid", "the URL must begin with https:// or http://")
    if "@" in url.split("/", 3)[2]:
        raise Refused("address.invalid", "the URL must not hold a user or a password")
    return parsed


class Sender:
    """Sends to customers' addresses.

    The name is resolved once and every address it has must be allowed; the connection goes to an
    address that was checked, so a name that changes between check and use gains nothing. Redirects
    are not followed and the environment's proxies not used.

    Parameters
    ----------
    timeout
        Seconds for everything, from the resolver to the last byte of the answer.
    allow
        Networks that are allowed although they are not public, on any port.
    resolver, tls
        Other than the system's, for tests.
    """

    def __init__(
        self,
        timeout: float,
        allow: Sequence[Network] = (),
        resolver: Resolve = resolve,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self._timeout = timeout
        self._allow = tuple(allow)
        self._resolver = resolver
        self._tls = tls or httpcore.default_ssl_context()

    def check(self, url: str) -> None:
        """Refuse a URL that could never be sent to, without asking anybody.

        Where a name leads is not looked up: that may take long, and another answer may hold by the
        time something is sent. Its port tells enough, unless the name can lead into a network that
        the operator allows.

        Raises
        ------
        Refused
            As by :meth:`post`.
        """
        origin = parse(url).origin
        addresses = _written(origin.host.decode())
        if addresses:
            _refuse(origin.host.decode(), origin.port, addresses, self._allow, is_typed=True)
        elif origin.port not in PORTS and not self._allow:
            raise _wrong_port(origin.port)

    def post(self, url: str, body: bytes, headers: Mapping[str, str]) -> Answer:
        """Send ``body``; any status is an answer.

        Raises
        ------
        Refused
            ``address.invalid``, ``address.port`` or ``address.private``: nothing was sent.
        Unreachable
            ``address.unknown``, ``connection.failed``, ``connection.tls`` or ``timeout``.
        """
        deadline = _Deadline(self._timeout)
        target = parse(url)
        backend = _CheckedBackend(self._allow, self._resolver, deadline)
        connection = httpcore.HTTPConnection(
            target.origin, ssl_context=self._tls, network_backend=backend
        )
        try:
            with (
                connection,
                connection.stream(
                    "POST", target, headers=list(headers.items()), content=body
                ) as response,
            ):
                return Answer(
                    response.status,
                    deadline.spent_ms(),
                    _read(response.iter_stream()),
                    _retry_after(response.headers),
                )
        except httpcore.TimeoutException as error:
            raise Unreachable("timeout", f"no answer within {self._timeout:g} s") from error
        except (httpcore.NetworkError, httpcore.ProtocolError, OSError) as error:
            raise _unreachable(error) from error


class _Deadline:
    """A moment by which everything must be over."""

    def __init__(self, seconds: float) -> None:
        self._start = time.monotonic()
        self._end = self._start + seconds

    def remaining(self) -> float:
        """Return the seconds left."""
        left = self._end - time.monotonic()
        if left <= 0:
            raise httpcore.ReadTimeout
        return left

    def spent_ms(self) -> int:
        return round(1000 * (time.monotonic() - self._start))


class _CheckedBackend(httpcore.NetworkBackend):
    """Connects to names whose addresses are all allowed."""

    def __init__(self, allow: Sequence[Network], resolver: Resolve, deadline: _Deadline) -> None:
        self._allow = allow
        self._resolver = resolver
        self._deadline = deadline
        self._plain = httpcore.SyncBackend()

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,  # noqa: ARG002 (one deadline for all)
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Resolve, check and connect."""
        addresses = self.allowed_addresses(host, port)
        for number, address in enumerate(addresses):
            share = self._deadline.remaining() / (len(addresses) - number)
            try:
                stream = self._plain.connect_tcp(
                    str(address), port, share, local_address, socket_options
                )
            except (httpcore.ConnectError, httpcore.ConnectTimeout):
                if address == addresses[-1]:
                    raise
                continue
            if _address(stream.get_extra_info("server_addr")[0]) != address:
                stream.close()
                raise Refused("address.private", f"{host} led to another address")
            return _TimedStream(stream, self._deadline)
        raise AssertionError("a name without addresses is refused before")

    def allowed_addresses(self, host: str, port: int) -> list[Address]:
        """Return the addresses of ``host``, which are all allowed."""
        found = _in_time(lambda: self._resolver(host, port), self._deadline.remaining())
        addresses = [_address(text) for text in found]
        if not addresses:
            raise Unreachable("address.unknown", f"{host} has no address")
        _refuse(host, port, addresses, self._allow, is_typed=False)
        return addresses[:MOST_TRIED]


class _TimedStream(httpcore.NetworkStream):
    """A connection on which every step gets only what is left of the time."""

    def __init__(self, stream: httpcore.NetworkStream, deadline: _Deadline) -> None:
        self._stream = stream
        self._deadline = deadline

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:  # noqa: ARG002
        return self._stream.read(max_bytes, self._deadline.remaining())

    def write(self, buffer: bytes, timeout: float | None = None) -> None:  # noqa: ARG002
        for start in range(0, len(buffer), WRITE_SIZE):
            self._stream.write(buffer[start : start + WRITE_SIZE], self._deadline.remaining())

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,  # noqa: ARG002
    ) -> httpcore.NetworkStream:
        stream = self._stream.start_tls(ssl_context, server_hostname, self._deadline.remaining())
        return _TimedStream(stream, self._deadline)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


def _read(chunks: Iterable[bytes]) -> bytes:
    """Return the beginning of an answer; the rest is never read."""
    body = bytearray()
    for chunk in chunks:
        body += chunk
        if len(body) >= MOST_ANSWER:
            break
    return bytes(body[:MOST_ANSWER])


def _retry_after(headers: Sequence[tuple[bytes, bytes]]) -> float | None:
    """Return the seconds that ``Retry-After`` asks for, as a number or as a date."""
    given = [value for name, value in headers if name.lower() == b"retry-after"]
    text = given[0].decode("latin-1").strip() if given else ""
    if DELTA_SECONDS.fullmatch(text):
        return float(text)
    try:
        moment = datetime.strptime(text, HTTP_DATE).replace(tzinfo=UTC)
    except ValueError:
        return None
    return max((moment - datetime.now(UTC)).total_seconds(), 0.0)


def _in_time(look_up: Callable[[], Sequence[str]], seconds: float) -> Sequence[str]:
    """Return what the resolver finds; it knows no time limit, so it is left behind if need be."""
    answers: queue.SimpleQueue[Sequence[str] | None] = queue.SimpleQueue()

    def ask() -> None:
        try:
            answers.put(look_up())
        except (OSError, UnicodeError):
            answers.put(None)

    threading.Thread(target=ask, daemon=True, name="resolver").start()
    try:
        found = answers.get(timeout=seconds)
    except queue.Empty as error:
        raise httpcore.ConnectTimeout from error
    if found is None:
        raise Unreachable("address.unknown", "the name has no address")
    return found


def _written(host: str) -> list[Address]:
    """Return the address that ``host`` is itself, in any notation; of a name none."""
    try:
        found = socket.getaddrinfo(
            host.strip("[]"), None, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST
        )
    except (OSError, UnicodeError):
        return []
    return [_address(str(entry[4][0])) for entry in found]


def _refuse(
    host: str, port: int, addresses: Sequence[Address], allow: Sequence[Network], *, is_typed: bool
) -> None:
    inner = [each for each in map(_embedded_ipv4, addresses) if not is_allowed(each, allow)]
    if inner:
        detail = (
            f"{host} is not a public address: the operator can allow its network by {ALLOWANCE}"
        )
        length = 24 if inner[0].version == 4 else 64
        network = ipaddress.ip_network((inner[0], length), strict=False)
        if not is_typed:  # where a name leads is for the operator alone: it maps their network
            log.warning("webhook.refused", host=host, network=str(network))
        elif not (inner[0].is_loopback or inner[0].is_link_local):
            detail += f", such as '[\"{network}\"]'"
        raise Refused("address.private", detail)
    if port not in PORTS and not all(is_named(address, allow) for address in addresses):
        raise _wrong_port(port)


def _wrong_port(port: int) -> Refused:
    detail = (
        f"port {port} is not one of 80, 443 and 8443: others are for networks that the operator "
        f"allows by {ALLOWANCE}"
    )
    return Refused("address.port", detail)


def _address(text: str) -> Address:
    return ipaddress.ip_address(text.partition("%")[0])


def _unreachable(error: BaseException) -> Unreachable:
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLError):
            return Unreachable("connection.tls", "the receiver's certificate or TLS is not valid")
        cause = cause.__cause__ or cause.__context__
    return Unreachable("connection.failed", "the connection failed")


def is_allowed(address: Address, allow: Sequence[Network] = ()) -> bool:
    """Return whether the service may connect to ``address``.

    Addresses that carry an IPv4 address (mapped, NAT64, 6to4) are judged by that one.
    """
    address = _embedded_ipv4(address)
    if is_named(address, allow):
        return True
    if address.is_multicast or any(_holds(network, address) for network in _SPECIAL):
        return False
    if address.version == 6 and not _holds(_GLOBAL_UNICAST, address):
        return False
    return address.is_global


def is_named(address: Address, allow: Sequence[Network]) -> bool:
    """Return whether the operator allows ``address`` by name."""
    return any(_holds(network, address) for network in allow)


def _embedded_ipv4(address: Address) -> Address:
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address.sixtofour is not None:
            return address.sixtofour
        if address in _NAT64:
            return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def _holds(network: Network, address: Address) -> bool:
    return network.version == address.version and address in network
