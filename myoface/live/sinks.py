"""Where followed faces go: OSC to another program, lines of JSON."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from typing import IO, Any

from myoface.client import LiveFrame
from myoface.live.lines import tell_frame, write_line
from myoface.live.osc_faces import write_face


class OscSink:
    """Sends faces by UDP; a receiver that is not there or too slow misses them."""

    def __init__(self, host: str, port: int) -> None:
        """Raise OSError for a host that is not known."""
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        family = found[0][0]
        self._address: tuple[Any, ...] = found[0][4]
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._ready: Mapping[str, Any] = {}
        self.lost = 0

    def face(self, frame: LiveFrame, latency_ms: float | None) -> None:  # noqa: ARG002
        """Send a face."""
        for packet in write_face(frame, self._ready):
            try:
                self._socket.sendto(packet, self._address)
            except OSError:  # nobody listens there, or the network is full
                self.lost += 1

    def said(self, message: Mapping[str, Any]) -> None:
        """Take note of names; programs that OSC drives want faces alone."""
        if message["type"] == "ready":
            self._ready = message

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class LineSink:
    """Writes what the session says to a stream, a line each."""

    def __init__(self, stream: IO[str]) -> None:
        self._ready: Mapping[str, Any] = {}
        self._stream = stream

    def face(self, frame: LiveFrame, latency_ms: float | None) -> None:
        """Write a face."""
        self._write(tell_frame(frame, self._ready, latency_ms))

    def said(self, message: Mapping[str, Any]) -> None:
        """Write a message as the session said it."""
        if message["type"] == "ready":
            self._ready = message
        self._write(message)

    def _write(self, said: Mapping[str, Any]) -> None:
        self._stream.write(write_line(said))
        self._stream.flush()
