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
        events, is_over = await to_thread.run_sync(_read, store, job_id, after)
        for event in events:
            yield ServerSentEvent(id=str(event.id), event=event.kind, data=event.data)
            after = event.id
            if event.kind == "state" and State(event.data["state"]) in FINAL:
                return
        if not events:
            if is_over:
                return
            await asyncio.sleep(PAUSE)


def _read(store: Store, job_id: str, after: int) -> tuple[list[Event], bool]:
    """Return the next events, and whether none will follow them: the job is over or deleted.

    The state is read first: a job that ends in between has its last event still to be sent.
    """
    with store.read() as session:
        job = session.get(Job, job_id)
        is_over = job is None or job.state in FINAL
        return list(repository.events(session, job_id, after)), is_over
