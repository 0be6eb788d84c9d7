"""Operations on live sessions: open, find, end."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from anyio import sleep, to_thread
from sqlalchemy.orm import Session

from service.errors import Problem, not_found
from service.jobs import repository as jobs
from service.jobs import service
from service.jobs.schemas import NewJob
from service.live.broker import LiveBroker, unreachable
from service.live.schemas import NewSession
from service.queue import table
from service.queue.states import FINAL, State
from service.queue.streams import Names, Sent
from service.queue.wakeups import AWAY
from service.rigs import repository as rigs
from service.store.database import Store
from service.store.models import Job
from solver.kinds.live_messages import Message
from solver.kinds.live_session import ENDING

KIND = "live_session"
# Attempts that may be lost: a session is long, and its worker soon given up
LEAST_ATTEMPTS = 10
# Seconds within which a session that was told to end has to say that it does, for which it is
# waited for while it stores its takes, and pauses meanwhile
ENDS_WITHIN = 10.0
STORES_WITHIN = 25.0
PAUSE = 0.2
# In the place of a connection's name
SERVICE = "service"
END = Message(b'{"end": true}', is_text=True)


def as_job(session: Session, new: NewSession) -> NewJob:
    """Return the job that a session is; raises a problem if there is no such rig."""
    rig = rigs.get(session, new.rig_id)
    given = new.model_dump(exclude={"source", "options"})
    options = {**new.options, "source": new.source}
    return NewJob.model_validate(
        {"kind": KIND, "subject_id": rig.subject_id, "options": options, **given}
    )


def check(store: Store, new: NewSession) -> None:
    """Refuse a session that cannot be, before anybody waits until it has been written."""
    with store.read() as session:
        order = as_job(session, new)
    service.check(store, order)


def open_session(session: Session, new: NewSession, max_attempts: int) -> Job:
    """Queue the job of a session that was checked."""
    most = max(max_attempts, LEAST_ATTEMPTS)
    return service.submit(session, as_job(session, new), most)[0]


def get(session: Session, session_id: str) -> Job:
    """Return a session's job."""
    try:
        job = jobs.get(session, session_id)
    except Problem:
        raise not_found("live_session", session_id) from None
    if job.kind != KIND:
        raise not_found("live_session", session_id)
    return job


def require_open(session: Session, session_id: str) -> Job:
    """Return a session's job; raises a problem if it is over."""
    job = get(session, session_id)
    if job.state in FINAL or job.state is State.CANCELING:
        detail = f"the session is over: its job is {job.state.value}"
        raise Problem(409, "live.over", detail, job_id=session_id, state=job.state)
    return job


async def end(store: Store, broker: LiveBroker, session_id: str) -> bool:
    """End a session: it stores its takes, and is canceled if it does not begin to within a while.

    Returns whether it was not over before.
    """

    def look() -> tuple[State, bool]:
        with store.read() as session:
            job = get(session, session_id)
            return job.state, (job.progress or {}).get("phase") == ENDING

    def cancel() -> None:
        with store.write() as session:
            table.cancel(session, session_id, "api", "the session was ended")

    found, is_ending = await to_thread.run_sync(look)
    if found in FINAL:
        return False
    is_told = False
    if found is State.RUNNING:
        with suppress(*AWAY):
            await broker.tell(Names.of(session_id), _own(END))
            is_told = True
    begin = time.monotonic()
    while is_told and found in (State.RUNNING, State.QUEUED):
        if time.monotonic() - begin > (STORES_WITHIN if is_ending else ENDS_WITHIN):
            break
        await sleep(PAUSE)
        found, is_ending = await to_thread.run_sync(look)
    if found not in FINAL and not is_ending:
        await to_thread.run_sync(cancel)
    return True


async def tell(store: Store, broker: LiveBroker, session_id: str, wish: Mapping[str, Any]) -> None:
    """Ask something of an open session, whose answer all who are connected to it hear."""

    def require() -> None:
        with store.read() as session:
            require_open(session, session_id)

    await to_thread.run_sync(require)
    try:
        await broker.tell(Names.of(session_id), _own(Message.of(wish)))
    except AWAY as error:
        raise unreachable() from error


def _own(message: Message) -> Sent:
    """Return a message of the service's, which counts with none of a station's."""
    return Sent(message, 0, SERVICE, is_frame=False)


def listed(rig_id: str | None, states: list[State] | None) -> list[Any]:
    """Return what holds of the sessions that are asked for."""
    wanted: list[Any] = [Job.kind == KIND]
    if rig_id is not None:
        wanted.append(Job.request["rig_id"].as_string() == rig_id)
    if states:
        wanted.append(Job.state.in_(states))
    return wanted
