"""The caller of a request: the tenant whose data it is about, and what the key may do."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.requests import HTTPConnection

from service.errors import Problem

# Key in `request.state`: callback by which the connection learns whose request it carries
AUTHENTICATED = "note_authenticated"


class Scope(StrEnum):
    """Permission of a key."""

    READ = "read"
    WRITE = "write"
    DELETE = "delete"
    WEBHOOKS = "webhooks"
    METRICS = "metrics"
    ADMIN = "admin"


@dataclass(frozen=True)
class Principal:
    """The owner of the key that a request came with."""

    tenant_id: str
    key_id: str
    scopes: frozenset[str]
    request_id: str = ""


_bearer = HTTPBearer(
    auto_error=False, scheme_name="key", description="an API key, `myo_` and 50 characters"
)
Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]


def principal(request: Request, credentials: Credentials) -> Principal:
    """Return whose key the request came with, and count it.

    Raises
    ------
    Problem
        401 without a key that is known, 429 if it asks too fast.
    """
    if credentials is None:
        raise missing_problem()
    address = request.client.host if request.client else ""
    who: Principal = request.app.state.keyring.verify(credentials.credentials, address)
    request.state.key_id = who.key_id
    note_authenticated(request, who.tenant_id)
    request.state.rate = request.app.state.rates.check(who.key_id, who.tenant_id)
    return replace(who, request_id=request.state.request_id)


def note_authenticated(request: HTTPConnection, tenant_id: str) -> None:
    """Tell the connection, if it wants to know, that its request is a tenant's."""
    if note := getattr(request.state, AUTHENTICATED, None):
        note(tenant_id)


def missing_problem() -> Problem:
    """Return the problem of a request without a key."""
    detail = "send an API key: Authorization: Bearer myo_...; the command line: MYOFACE_API_KEY"
    return unauthorized_problem("auth.missing", detail)


def unauthorized_problem(code: str, detail: str) -> Problem:
    """Return the problem of a key that opens nothing."""
    problem = Problem(401, code, detail)
    problem.headers = {"WWW-Authenticate": "Bearer"}
    return problem


# The caller, whatever its key may do
Caller = Annotated[Principal, Depends(principal)]


def need_scope(scope: Scope) -> Callable[[Principal], Awaitable[Principal]]:
    """Return a dependency that gives the caller if its key has ``scope``."""

    async def check_scope(who: Caller) -> Principal:
        return require(scope, who)

    return check_scope


def require(scope: Scope, who: Principal) -> Principal:
    """Return the caller, or raise a problem if its key lacks ``scope``."""
    if scope not in who.scopes:
        detail = f"the key may not do this: it lacks the scope {scope.value}"
        raise Problem(403, "auth.scope", detail, expected=scope.value, found=sorted(who.scopes))
    return who


Reader = Annotated[Principal, Depends(need_scope(Scope.READ))]
Writer = Annotated[Principal, Depends(need_scope(Scope.WRITE))]
Deleter = Annotated[Principal, Depends(need_scope(Scope.DELETE))]
Hooks = Annotated[Principal, Depends(need_scope(Scope.WEBHOOKS))]
Admin = Annotated[Principal, Depends(need_scope(Scope.ADMIN))]
