"""A receiver of webhooks on this machine, which answers with what a test asks for."""

from __future__ import annotations

import http.server
import ipaddress
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

LOOPBACK = [ipaddress.ip_network("127.0.0.0/8")]


class Receiver(http.server.BaseHTTPRequestHandler):
    """Answers with what the test asks for, and keeps what it was sent."""

    got: list[tuple[str, dict[str, str], bytes]]
    script: Callable[[Receiver], None]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.got.append((self.path, {k.lower(): v for k, v in self.headers.items()}, body))
        self.script()

    def log_message(self, *_: Any) -> None:
        pass


def ok(receiver: Receiver) -> None:
    receiver.send_response(204)
    receiver.end_headers()


@contextmanager
def receiving(
    script: Callable[[Receiver], None] = ok, tls: ssl.SSLContext | None = None
) -> Iterator[tuple[int, list[tuple[str, dict[str, str], bytes]]]]:
    """Run a receiver on this machine; gives its port and what it got."""
    got: list[tuple[str, dict[str, str], bytes]] = []
    handler = type("Handler", (Receiver,), {"got": got, "script": script})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    if tls:
        server.socket = tls.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    try:
        yield server.server_address[1], got
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
