"""A real server on this machine, with little patience, and a raw connection to it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from service.http.deadline import SocketProtocol, protocol
from service.http.slots import ConnectionSlots

ROOM: ConnectionSlots[Any] = ConnectionSlots(10_000, 10_000, 10_000)


@contextmanager
def serving(
    app: ASGIApp, seconds: float, slots: ConnectionSlots[Any] | None = None, **more: Any
) -> Iterator[int]:
    """Serve ``app`` as `service.__main__` does; gives the port."""
    http = protocol(seconds, seconds, slots or ROOM)
    config = uvicorn.Config(app, port=0, http=http, ws=SocketProtocol, log_config=None, **more)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        while not server.started:
            time.sleep(0.01)
        yield server.servers[0].sockets[0].getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def connected(port: int) -> Iterator[socket.socket]:
    """Connect to the server."""
    with socket.create_connection(("127.0.0.1", port), timeout=10) as connection:
        yield connection


def until_closed(connection: socket.socket) -> tuple[bytes, float]:
    """Return what the server sends until it hangs up, and after how many seconds it does."""
    started = time.monotonic()
    received = b""
    while True:
        try:
            chunk = connection.recv(65_536)
        except ConnectionResetError:
            chunk = b""
        if not chunk:
            return received, time.monotonic() - started
        received += chunk
