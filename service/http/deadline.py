"""A connection that keeps the service waiting is closed.

uvicorn waits for ever for the first byte, for the end of the headers, and for the rest of a body
after it was refused. A few hundred such connections would be all that the process can hold.
"""

from __future__ import annotations

import asyncio
import uuid
from typing import Any, ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from service.errors import Problem, render


class DeadlineProtocol(H11Protocol):
    """HTTP/1.1 with a limit, in seconds, on the time without a request that the service works on.

    It runs from the connection, or from the first byte after an answer, until the headers of a
    request have arrived. From then on `service.http.bodies` keeps the time.
    """

    seconds: ClassVar[float]

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the clock."""
        super().connection_made(transport)
        self._start()

    def data_received(self, data: bytes) -> None:
        """Take bytes, and see whether they make a request."""
        super().data_received(data)
        if self.transport.is_closing() or self._busy():
            self._stop()
        else:
            self._start()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the clock."""
        super().connection_lost(exc)
        self._stop()

    def send_400_response(self, msg: str) -> None:
        """Answer what is not HTTP with a problem document like all others."""
        self._refuse(Problem(400, "request.malformed", msg))

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


def protocol(seconds: float) -> type[DeadlineProtocol]:
    """Return the protocol class for uvicorn's ``http``."""
    return type("Protocol", (DeadlineProtocol,), {"seconds": seconds})
