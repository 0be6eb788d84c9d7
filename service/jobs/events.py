"""A job's events as a stream: the table is asked again and again, so any process can answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from anyio import to_thread
from fastapi.sse import ServerSentEvent

from service.jobs import repository
from service.store.models import Event, Job
from service.store.store import Store
from service.store.transitions import FINAL, State

PAUSE = 0.3


async def stream(store: Store, job_id: str, after: int) -> AsyncIterator[ServerSentEvent]:
    """Give a job's events after the event ``after``, until it is over."""
    while True:
        events = await to_thread.run_sync(_read, store, job_id, after)
        for event in events:
            yield ServerSentEvent(id=str(event.id), event=event.kind, data=event.data)
            after = event.id
            if event.kind == "state" and State(event.data["state"]) in FINAL:
                return
        if not events:
            if await to_thread.run_sync(_is_over, store, job_id):
                return
            await asyncio.sleep(PAUSE)


def _read(store: Store, job_id: str, after: int) -> list[Event]:
    with store.read() as session:
        return list(repository.events(session, job_id, after))


def _is_over(store: Store, job_id: str) -> bool:
    """Tell whether nothing will come: the last event was seen before, or the job was deleted."""
    with store.read() as session:
        job = session.get(Job, job_id)
        return job is None or job.state in FINAL
