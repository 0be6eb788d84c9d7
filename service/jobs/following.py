"""Jobs' events for all who watch: one thread of a process asks the table for all of them at once.

It is asked again and again, so any API process can answer, whichever worker wrote the events.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence, Set
from dataclasses import dataclass, field

import structlog
from anyio import to_thread
from sqlalchemy import and_, or_, select
from sqlalchemy.exc import SQLAlchemyError

from service.queue.states import FINAL, State
from service.store.database import Store, clock
from service.store.models import ApiKey, Event, Job

PAUSE = 0.3
# Seconds after which a revoked key no longer sees anything
LOOK_AT_KEYS_EVERY = 10.0
# Events read ahead for a client that takes them slowly
MOST_AT_ONCE = 1000
# Watchers in one query, which has two parameters for each
MOST_WATCHERS_AT_ONCE = 200

log = structlog.get_logger()


@dataclass(eq=False)
class _Watcher:
    """One who has seen the events of a job up to ``after``; None in ``news`` is the end."""

    job_id: str
    after: int
    key_id: str
    news: asyncio.Queue[Event | None] = field(default_factory=asyncio.Queue)


class Feed:
    """The events of all tenants' jobs: whoever follows one must be known to be allowed to."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._watchers: set[_Watcher] = set()
        self._keys_seen = time.monotonic()
        self._task: asyncio.Task[None] | None = None

    async def follow(self, job_id: str, after: int, key_id: str) -> AsyncIterator[Event]:
        """Give a job's events after the event ``after``, until it is over or deleted.

        It also ends when the key with which it is followed is revoked or has expired.
        """
        watcher = _Watcher(job_id, after, key_id)
        self._watchers.add(watcher)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._serve())
        try:
            while (event := await watcher.news.get()) is not None:
                yield event
                if event.kind == "state" and State(event.data["state"]) in FINAL:
                    return
        finally:
            self._watchers.discard(watcher)

    async def _serve(self) -> None:
        """Ask for news until nobody watches any more."""
        while self._watchers:
            watchers = [each for each in self._watchers if each.news.qsize() < MOST_AT_ONCE]
            is_behind = False
            for first in range(0, len(watchers), MOST_WATCHERS_AT_ONCE):
                some = watchers[first : first + MOST_WATCHERS_AT_ONCE]
                try:
                    over, events = await to_thread.run_sync(self._read, some)
                except SQLAlchemyError as error:
                    log.warning("database.unreachable", error=str(error))
                    continue
                is_behind |= len(events) == MOST_AT_ONCE
                _tell(some, over, events)
            await self._look_at_keys()
            await asyncio.sleep(0 if is_behind else PAUSE)

    async def _look_at_keys(self) -> None:
        if time.monotonic() - self._keys_seen < LOOK_AT_KEYS_EVERY:
            return
        self._keys_seen = time.monotonic()
        watchers = list(self._watchers)
        try:
            valid = await to_thread.run_sync(self._valid, {each.key_id for each in watchers})
        except SQLAlchemyError as error:
            log.warning("database.unreachable", error=str(error))
            return
        for watcher in watchers:
            if watcher.key_id not in valid:
                watcher.news.put_nowait(None)

    def _valid(self, key_ids: Set[str]) -> Set[str]:
        with self._store.read() as session:
            moment = clock(session)
            ends = (ApiKey.revoked_at, ApiKey.expires_at)
            holds = [or_(end.is_(None), end > moment) for end in ends]
            return set(session.scalars(select(ApiKey.id).where(ApiKey.id.in_(key_ids), *holds)))

    def _read(self, watchers: Sequence[_Watcher]) -> tuple[set[str], Sequence[Event]]:
        """Return which jobs are over or deleted, and the next events.

        The states are read first: a job that ends in between has its last event still to be sent.
        """
        unseen = {(watcher.job_id, watcher.after) for watcher in watchers}
        job_ids = {job_id for job_id, _ in unseen}
        conditions = [and_(Event.job_id == job_id, Event.id > after) for job_id, after in unseen]
        with self._store.read() as session:
            going_on = select(Job.id).where(Job.id.in_(job_ids), Job.state.not_in(FINAL))
            over = job_ids - set(session.scalars(going_on))
            events = session.scalars(
                select(Event).where(or_(*conditions)).order_by(Event.id).limit(MOST_AT_ONCE)
            ).all()
        return over, events


def _tell(watchers: Sequence[_Watcher], over: set[str], events: Sequence[Event]) -> None:
    of_job: dict[str, list[Event]] = {}
    for event in events:
        of_job.setdefault(event.job_id, []).append(event)
    for watcher in watchers:
        news = [event for event in of_job.get(watcher.job_id, ()) if event.id > watcher.after]
        for event in news:
            watcher.news.put_nowait(event)
            watcher.after = event.id
        if not news and watcher.job_id in over and len(events) < MOST_AT_ONCE:
            watcher.news.put_nowait(None)
