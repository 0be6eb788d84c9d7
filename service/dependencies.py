"""What routes ask for, by type."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from fastapi import Depends, Query, Request
from sqlalchemy.orm import Session

from service.access.principal import Admin, Deleter, Hooks, Reader, Writer
from service.access.signed import FileReader
from service.settings import Settings
from service.store.store import Store

# What does not wait is `async`: FastAPI would run each in a thread of its own, many a request.


async def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def _store(request: Request) -> Store:
    store: Store = request.app.state.store
    return store


SettingsDep = Annotated[Settings, Depends(_settings)]
WholeStore = Annotated[Store, Depends(_store)]
"""All tenants' data: for the service's own health, never for what a route is asked about."""


async def _for_reading(store: WholeStore, who: Reader) -> Store:
    return store.of(who.tenant_id)


async def _for_downloading(store: WholeStore, who: FileReader) -> Store:
    return store.of(who.tenant_id)


async def _for_writing(store: WholeStore, who: Writer) -> Store:
    return store.of(who.tenant_id)


async def _for_deleting(store: WholeStore, who: Deleter) -> Store:
    return store.of(who.tenant_id)


async def _for_hooks(store: WholeStore, who: Hooks) -> Store:
    return store.of(who.tenant_id)


async def _for_administering(store: WholeStore, who: Admin) -> Store:
    return store.of(who.tenant_id)


ReadStore = Annotated[Store, Depends(_for_reading)]
FileStore = Annotated[Store, Depends(_for_downloading)]
"""For a file alone: a signed URL is as good as a key."""
WriteStore = Annotated[Store, Depends(_for_writing)]
DeleteStore = Annotated[Store, Depends(_for_deleting)]
AdminStore = Annotated[Store, Depends(_for_administering)]
HookStore = Annotated[Store, Depends(_for_hooks)]


def _reading(store: ReadStore) -> Iterator[Session]:
    with store.read() as session:
        yield session


def _writing(store: WriteStore) -> Iterator[Session]:
    with store.write() as session:
        yield session


def _deleting(store: DeleteStore) -> Iterator[Session]:
    with store.write() as session:
        yield session


def _of_hooks(store: HookStore) -> Iterator[Session]:
    with store.write() as session:
        yield session


def _administering(store: AdminStore) -> Iterator[Session]:
    with store.write() as session:
        yield session


ReadSession = Annotated[Session, Depends(_reading, scope="function")]
# "function": the commit, and the wake-up calls after it, come before the response.
WriteSession = Annotated[Session, Depends(_writing, scope="function")]
DeleteSession = Annotated[Session, Depends(_deleting, scope="function")]
AdminSession = Annotated[Session, Depends(_administering, scope="function")]
HookSession = Annotated[Session, Depends(_of_hooks, scope="function")]

Cursor = Annotated[
    str | None, Query(max_length=200, description="`next` of the page before; default: the newest")
]
Limit = Annotated[int, Query(ge=1, le=1000, description="at most so many items")]
