"""Dependencies of routes, by type."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from functools import cache
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Query, Request
from sqlalchemy.orm import Session

from service.access.principal import Caller, Scope, require
from service.access.signed import FileReader
from service.records.audit import ReadLog
from service.schemas import Label
from service.settings import Settings
from service.store.ballast import Ballast
from service.store.database import Store
from service.writers import PATIENCE, Places

# Methods that write nothing, or hardly ever
READING = frozenset({"GET", "HEAD"})

# What does not wait is `async`: FastAPI would run each in a thread of its own, many a request.
# The makers are cached: one dependency a name and scope, which a test can override by them.

_asked_for: set[str] = set()


@cache
def part(name: str) -> Callable[[Request], Awaitable[Any]]:
    """Return the dependency that gives the part ``name`` of the application's state."""

    async def of_app(request: Request) -> Any:
        return getattr(request.app.state, name)

    _asked_for.add(name)
    return of_app


def check_parts(app: FastAPI) -> None:
    """Refuse, at the start, an application without a part that a route asks for.

    Raises
    ------
    LookupError
        naming those that are missing.
    """
    missing = sorted(name for name in _asked_for if not hasattr(app.state, name))
    if missing:
        raise LookupError(f"the application has no {', '.join(missing)}")


SettingsDep = Annotated[Settings, Depends(part("settings"))]
BallastDep = Annotated[Ballast, Depends(part("ballast"))]
ReadsDep = Annotated[ReadLog, Depends(part("reads"))]
# All tenants' data: for the service's own health, never for what a route is asked about
WholeStore = Annotated[Store, Depends(part("store"))]


async def _take_turn(
    request: Request, writers: Annotated[Places, Depends(part("writers"))]
) -> AsyncIterator[float]:
    """Give the moment by which a request's writes must begin; one that is to write has a place."""
    if request.method in READING:
        yield time.monotonic() + PATIENCE
        return
    async with writers.place() as until:
        yield until


Turn = Annotated[float, Depends(_take_turn, scope="function")]


@cache
def own_store(scope: Scope) -> Callable[[Store, Caller, float], Awaitable[Store]]:
    """Return the dependency that gives the data of a caller whose key has ``scope``."""

    async def own(store: WholeStore, who: Caller, until: Turn) -> Store:
        return store.of(require(scope, who).tenant_id).by(until)

    return own


@cache
def own_session(
    scope: Scope,
) -> Callable[[Store, Caller, float, Ballast, Request], Iterator[Session]]:
    """Return the dependency that opens a database session and commits it unless it only read.

    Whatever deletes finds room on a full disk: a key that leaked must be revoked then, too.
    """

    def session(
        store: WholeStore, who: Caller, until: Turn, ballast: BallastDep, request: Request
    ) -> Iterator[Session]:
        own = store.of(require(scope, who).tenant_id).by(until)
        if request.method == "DELETE":
            ballast.drop()
        reads = scope is Scope.READ or request.method in READING
        with own.read() if reads else own.write() as session:
            yield session

    return session


async def _for_downloading(store: WholeStore, who: FileReader) -> Store:
    return store.of(who.tenant_id)


async def _for_receiving(store: WholeStore, who: Caller) -> Store:
    return store.of(require(Scope.WRITE, who).tenant_id)


ReadStore = Annotated[Store, Depends(own_store(Scope.READ))]
# For a file alone: a signed URL is as good as a key
FileStore = Annotated[Store, Depends(_for_downloading)]
# For bytes that take their time: a place is taken when they count
ReceivingStore = Annotated[Store, Depends(_for_receiving)]
WriteStore = Annotated[Store, Depends(own_store(Scope.WRITE))]

# "function": the commit, and the wake-up calls after it, come before the response.
ReadSession = Annotated[Session, Depends(own_session(Scope.READ), scope="function")]
WriteSession = Annotated[Session, Depends(own_session(Scope.WRITE), scope="function")]
DeleteSession = Annotated[Session, Depends(own_session(Scope.DELETE), scope="function")]
AdminSession = Annotated[Session, Depends(own_session(Scope.ADMIN), scope="function")]
HookSession = Annotated[Session, Depends(own_session(Scope.WEBHOOKS), scope="function")]

Cursor = Annotated[
    str | None, Query(max_length=200, description="`next` of the page before; default: the newest")
]
Limit = Annotated[int, Query(ge=1, le=1000, description="at most so many items")]
WithLabels = Annotated[
    list[Label] | None,
    Query(
        alias="label",
        max_length=8,
        description="only those with this label, `key:value` or a `key`; of several, with all",
    ),
]
