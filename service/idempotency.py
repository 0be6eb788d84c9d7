"""``Idempotency-Key``: a POST that is sent again makes nothing a second time.

What is kept is the id of what the first request made, in its transaction: a request that failed
left nothing, and what was deleted meanwhile is not shown from a copy.
"""

from __future__ import annotations

import hashlib
from typing import Annotated

from fastapi import Depends, Header, Request
from pydantic import BaseModel
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.database import Store, clock
from service.store.models import AnsweredRequest
from service.store.tenancy import tenant_of


class RequestAttempt:
    """One sending of a request, which has the caller's ``key`` or none."""

    def __init__(self, key: str | None, line: str) -> None:
        self._key = key
        self._line = line
        self._kept: AnsweredRequest | None = None

    def is_answered(self, store: Store, body: BaseModel) -> bool:
        """Return whether an earlier sending made something; takes nothing, and waits for nobody."""
        with store.read() as session:
            return self._look_up(session, self._fingerprint(body)) is not None

    def find_answered(self, session: Session, body: BaseModel | None = None) -> str | None:
        """Return the id that an earlier sending made; None: this is the first.

        Raises
        ------
        Problem
            422 if the key came with another request, 409 if that one is being served.
        """
        fingerprint = self._fingerprint(body)
        found = self._look_up(session, fingerprint)
        if found is None and self._key is not None:
            self._reserve(session, fingerprint)
        return found

    def _look_up(self, session: Session, fingerprint: str) -> str | None:
        if self._key is None:
            return None
        found = session.get(AnsweredRequest, (tenant_of(session), self._key))
        if found is None:
            return None
        if found.fingerprint != fingerprint:
            raise Problem(
                422, "idempotency.conflict", "this Idempotency-Key came with another request"
            )
        return found.object_id

    def _fingerprint(self, body: BaseModel | None) -> str:
        content = f"{self._line}\n{body.model_dump_json() if body else ''}"
        return hashlib.sha256(content.encode()).hexdigest()

    def keep(self, session: Session, object_id: str) -> None:
        """Note what this sending made."""
        if self._kept is not None:
            self._kept.object_id = object_id
            session.flush()

    def _reserve(self, session: Session, fingerprint: str) -> None:
        """Take the key; on PostgreSQL that waits for the request that has it to end."""
        self._kept = AnsweredRequest(
            tenant_id=tenant_of(session),
            key=self._key,
            fingerprint=fingerprint,
            object_id="",
            created_at=clock(session),
        )
        session.add(self._kept)
        try:
            session.flush()
        except IntegrityError as error:
            problem = Problem(
                409, "idempotency.in_flight", "the same request was being served; send it again"
            )
            problem.headers = {"Retry-After": "1"}
            raise problem from error


async def _attempt(
    request: Request,
    key: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            pattern=r"^[\x21-\x7e]{1,255}$",
            description="made by the caller, kept for a day: the request can be repeated safely",
        ),
    ] = None,
) -> RequestAttempt:
    return RequestAttempt(key, f"{request.method} {request.url.path}")


Once = Annotated[RequestAttempt, Depends(_attempt)]
