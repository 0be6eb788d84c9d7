"""Tickets: what opens one connection to a live session, once, within a minute.

A browser's WebSocket sends no headers of a page's own, so a connection cannot show a key. A ticket
is signed as a URL is, and says for which session, by whose key and as what it was asked for.
"""

from __future__ import annotations

import re
import secrets
import time
from dataclasses import dataclass
from datetime import UTC, datetime

from service.access.principal import Principal, Scope
from service.access.signed import Refusals, Signer
from service.errors import Problem

PURPOSE = b"live tickets"
REFUSALS = Refusals(
    ("ticket.invalid", "the ticket is not as it was made, or for another session"),
    ("ticket.expired", "the ticket's time is over: ask for another"),
)
FORM = re.compile(r"([sw])\.([0-9A-Za-z-]{1,36})\.([0-9A-Za-z_-]{22})\.([0-9A-Za-z._-]{1,120})")
STATION = "s"
WATCHER = "w"


@dataclass(frozen=True)
class Ticket:
    """A ticket that holds: ``nonce`` is its own, ``who`` asked for it."""

    session_id: str
    who: Principal
    nonce: str
    is_station: bool


class Tickets:
    """Makes tickets that last ``seconds``, and tells whether one is good."""

    def __init__(self, secret: bytes, seconds: int) -> None:
        self._signer = Signer(secret, PURPOSE, REFUSALS)
        self.seconds = seconds

    def make(self, session_id: str, who: Principal, *, watch: bool) -> tuple[str, datetime]:
        """Return a ticket and when its time is over."""
        until = int(time.time()) + self.seconds
        head = f"{WATCHER if watch else STATION}.{who.key_id}.{secrets.token_urlsafe(16)}"
        token = self._signer.token(_path(session_id, head), who.tenant_id, until)
        return f"{head}.{token}", datetime.fromtimestamp(until, UTC)

    def verify(self, session_id: str, given: str, request_id: str) -> Ticket:
        """Return the ticket that a text is.

        Raises
        ------
        Problem
            403 for one that was not made here for this session, or whose time is over.
        """
        match = FORM.fullmatch(given)
        if match is None:
            raise Problem(403, *REFUSALS.invalid)
        role, key_id, nonce, token = match.groups()
        path = _path(session_id, f"{role}.{key_id}.{nonce}")
        tenant_id = self._signer.verify(path, token)
        scopes = {Scope.READ, Scope.WRITE} if role == STATION else {Scope.READ}
        who = Principal(tenant_id, key_id, frozenset(scopes), request_id)
        return Ticket(session_id, who, nonce, role == STATION)


def address(session_id: str, ticket: str) -> str:
    """Return the address, relative to the service's, that a ticket opens."""
    return f"/v1/live/{session_id}/frames?ticket={ticket}"


def _path(session_id: str, head: str) -> str:
    return f"/v1/live/{session_id}/frames?{head}"
