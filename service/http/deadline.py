"""A connection that keeps the service waiting is closed.

uvicorn waits for ever for the first byte, for the end of the headers, for the rest of a body after
it was refused, and for a client that does not read its answer. A few hundred such connections would
be all that the process can hold; `ConnectionSlots` says which of them is closed for another.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import uuid
from collections.abc import Callable
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from service.access.principal import AUTHENTICATED
from service.errors import Problem, render
from service.http.slots import ConnectionSlots

# Cap on unsent kernel bytes. The default buffer is megabytes, so a stalled reader would go
# unnoticed.
MOST_UNSENT = 128 * 1024
# SO_LINGER 0: drop unsent data when we reset the connection.
AT_ONCE = struct.pack("ii", 1, 0)


QUIET = logging.getLogger("myoface.sockets")
QUIET.setLevel(logging.WARNING)


class SocketProtocol(WebSocketsSansIOProtocol):
    """A WebSocket, which says when it is lost: the slot of its connection is another protocol's."""

    on_lost: Callable[[], None] = staticmethod(lambda: None)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.logger = QUIET  # uvicorn logs addresses, and these have tickets in them

    def connection_lost(self, exc: Exception | None) -> None:
        """Give the slot back."""
        super().connection_lost(exc)
        self.on_lost()


class DeadlineProtocol(H11Protocol):
    """HTTP/1.1 with limits, in seconds, on the time without a request and on that without a reader.

    The first runs from the connection, or from the first byte after an answer, until the headers of
    a request have arrived. From then on `service.http.bodies` keeps the time.

    The second runs while bytes of an answer wait for the client, and anew when some were taken:
    one that is slow gets its file, one that has stopped is cut off. The kernel asks for more only
    when half of what it may hold has gone, so the least rate is about 64 KB in that time; TLS, and
    a client whose own kernel takes megabytes ahead, may need some hundred. An answer goes on only
    when the client has taken what was written, so that one piece of it is all that waits in memory.
    """

    seconds: ClassVar[float]
    send_seconds: ClassVar[float]
    slots: ClassVar[ConnectionSlots[DeadlineProtocol]]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # of every request's state
        self.app_state = {**self.app_state, AUTHENTICATED: self._note_tenant}
        self._is_upgraded = False
        self._deadline: asyncio.TimerHandle | None = None
        self._patience: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=1, low=0)  # "paused": something waits for the client
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, MOST_UNSENT)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux; elsewhere the system's own quarter hour
            limit = round(1000 * self.send_seconds)  # for one whose host is gone: nothing answers
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limit)
        self._start()
        address = self.client[0] if self.client else ""
        _abort(self.slots.open(self, address))

    def pause_writing(self) -> None:
        """Hold the answer, until the client has taken what waits for it."""
        super().pause_writing()
        self._be_patient(self.transport.get_write_buffer_size())

    def resume_writing(self) -> None:
        """Go on with the answer."""
        super().resume_writing()
        self._stop_being_patient()

    def data_received(self, data: bytes) -> None:
        """Take bytes, and see whether they make a request."""
        super().data_received(data)
        if self.transport.is_closing() or self._busy() or self._is_upgraded:
            self._stop()
        else:
            self._start()

    def handle_events(self) -> None:
        """Serve what has arrived; a request has begun before its key is looked up."""
        super().handle_events()
        if self._busy():
            self.slots.begin(self)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        """Hand the connection over; its slot is a busy one's until it is lost."""
        self._is_upgraded = True
        self.slots.begin(self)
        super().handle_websocket_upgrade(event)
        upgraded = self.transport.get_protocol()
        assert isinstance(upgraded, SocketProtocol)
        upgraded.on_lost = self._forget

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock."""
        super().connection_lost(exc)
        self._forget()

    def _forget(self) -> None:
        self.slots.close(self)
        self._stop()
        self._stop_being_patient()

    def send_400_response(self, msg: str) -> None:
        """Answer what is not HTTP with a problem document like all others."""
        self._refuse(Problem(400, "request.malformed", msg))

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self.slots.rest(self)  # first: a request that came with this one begins in the next line
        super().on_response_complete()

    def _note_tenant(self, tenant_id: str) -> None:
        """Note whose request this is; called from the thread that looked its key up."""
        self.loop.call_soon_threadsafe(self._take_slot, tenant_id)

    def _take_slot(self, tenant_id: str) -> None:
        _abort(self.slots.authenticate(self, tenant_id))

    def _busy(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _start(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(self.seconds, self._too_late)

    def _stop(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _too_late(self) -> None:
        self._deadline = None
        if self.transport.is_closing() or self._busy():
            return
        if self.conn.trailing_data[0]:  # the beginning of a request
            detail = f"the request's headers did not arrive within {self.seconds:g} s"
            self._refuse(Problem(408, "request.timeout", detail))
        else:
            self.transport.close()

    def _be_patient(self, waiting: int) -> None:
        self._patience = self.loop.call_later(self.send_seconds, self._look_at_reader, waiting)

    def _stop_being_patient(self) -> None:
        if self._patience is not None:
            self._patience.cancel()
            self._patience = None

    def _look_at_reader(self, waited: int) -> None:
        """Cut off a client that has taken nothing since ``waited`` bytes waited for it."""
        waiting = self.transport.get_write_buffer_size()
        if waiting < waited:
            self._be_patient(waiting)
        else:
            connection = self.transport.get_extra_info("socket")
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, AT_ONCE)
            self.transport.abort()

    def _refuse(self, problem: Problem) -> None:
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            problem.headers = {"Connection": "close"}
            answer = render(uuid.uuid4().hex, problem)
            headers = list(answer.raw_headers)
            body = bytes(answer.body)
            for event in (
                h11.Response(status_code=problem.status, headers=headers),
                h11.Data(data=body),
                h11.EndOfMessage(),
            ):
                self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


def _abort(connection: DeadlineProtocol | None) -> None:
    if connection is not None:
        connection.transport.abort()


def protocol(
    seconds: float, send_seconds: float, slots: ConnectionSlots[DeadlineProtocol]
) -> type[DeadlineProtocol]:
    """Return the protocol class for uvicorn's ``http``: its limits on requests, answers, slots."""
    limits = {"seconds": seconds, "send_seconds": send_seconds, "slots": slots}
    return type("Protocol", (DeadlineProtocol,), limits)
