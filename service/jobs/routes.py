"""Routes of jobs."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service import paging
from service.access.limits import ConnectionLimit
from service.access.principal import Principal, Reader, Writer
from service.dependencies import (
    Cursor,
    Limit,
    ReadsDep,
    ReadSession,
    ReadStore,
    SettingsDep,
    WriteSession,
    WriteStore,
    part,
)
from service.errors import problems
from service.idempotency import Once
from service.jobs import repository, service
from service.jobs.following import Feed
from service.jobs.schemas import (
    Cancel,
    Filters,
    FramesView,
    JobItem,
    JobView,
    LogView,
    NewJob,
    Retry,
)
from service.queue.claims import positions
from service.records.audit import record
from service.schemas import Id, Page, Position
from service.settings import Settings
from service.store.database import Store
from service.store.models import Job
from service.store.retention import own_days
from service.subjects import repository as subjects
from service.writers import Places

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


@router.post("", status_code=201, summary="Submit a job", responses=problems(404, 409, 422))
def create(
    new: NewJob,
    store: WriteStore,
    session: WriteSession,
    who: Writer,
    once: Once,
    settings: SettingsDep,
) -> JobView:
    """Queue a piece of work; `PUT` is the same and can be repeated safely."""
    if not once.is_answered(store, new):
        service.check(store, new)
    if (known := once.find_answered(session, new)) is not None:
        return _view(session, known, settings)
    job, _ = service.submit(session, new, settings.max_attempts)
    once.keep(session, job.id)
    record(session, who, "job.created", job.id)
    return _view(session, job.id, settings)


@router.put(
    "/{job_id}",
    status_code=201,
    summary="Submit a job under an id of your own",
    responses={
        200: {"model": JobView, "description": "The job was there already"},
        **problems(404, 409, 422),
    },
)
def put(
    job_id: Id,
    new: NewJob,
    response: Response,
    store: WriteStore,
    who: Writer,
    settings: SettingsDep,
) -> JobView:
    """Queue a piece of work once, however often it is asked for (a UUID made by the caller)."""
    if not service.exists(store, job_id):
        service.check(store, new)
    try:
        is_new = _submit(store, new, settings.max_attempts, job_id, who)
    except IntegrityError:  # another request with this id committed first: find its job
        try:
            is_new = _submit(store, new, settings.max_attempts, job_id, who)
        except IntegrityError as error:  # another tenant's
            raise service.id_conflict(job_id) from error
    response.status_code = 201 if is_new else 200
    with store.read() as session:
        return _view(session, job_id, settings)


def _submit(store: Store, new: NewJob, max_attempts: int, job_id: str, who: Principal) -> bool:
    with store.write() as session:
        _, is_new = service.submit(session, new, max_attempts, job_id)
        if is_new:
            record(session, who, "job.created", job_id)
        return is_new


@router.get("", response_model=Page[JobItem], summary="List jobs", responses=problems(422))
def index(
    session: ReadSession,
    settings: SettingsDep,
    wanted: Filters,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """List jobs, newest first, in short; each one's own path has its options, figures and files."""
    jobs = repository.newest(session, wanted, limit, cursor)
    names = subjects.names(session, [job.subject_id for job in jobs.items])
    places = positions(session, jobs.items)
    kept = own_days(session, settings)
    items = [
        JobItem.of(job, names.get(job.subject_id, ""), places.get(job.id), kept)
        for job in jobs.items
    ]
    return paging.respond(Page[JobItem](items=items, next=jobs.next))


@router.get("/{job_id}", summary="Show a job", responses=problems(404, 422))
def show(job_id: Id, session: ReadSession, settings: SettingsDep) -> JobView:
    """Show a job's state, progress, attempts, error and result."""
    return _view(session, job_id, settings)


@router.post(
    "/{job_id}/retry",
    status_code=201,
    summary="Make a job again",
    responses=problems(404, 409, 422),
)
def retry(
    job_id: Id,
    session: WriteSession,
    who: Writer,
    once: Once,
    settings: SettingsDep,
    wanted: Retry | None = None,
) -> JobView:
    """Queue a job that is over once more, as it was or with other captures, options, priority.

    It is a new job with this one as its `parent_id`; it reads the subject's files as they are now.
    """
    changes = wanted or Retry()
    if (known := once.find_answered(session, changes)) is not None:
        return _view(session, known, settings)
    job = service.retry(session, job_id, changes, settings.max_attempts)
    once.keep(session, job.id)
    record(session, who, "job.created", job.id)
    return _view(session, job.id, settings)


@router.post("/{job_id}/cancel", summary="Stop a job", responses=problems(404, 409, 422))
def cancel(
    job_id: Id,
    session: WriteSession,
    who: Writer,
    settings: SettingsDep,
    order: Cancel | None = None,
) -> JobView:
    """Stop a job: a running one is `canceling` until its solver is gone, a few seconds at most."""
    service.cancel(session, job_id, order or Cancel())
    record(session, who, "job.canceled", job_id)
    return _view(session, job_id, settings)


def _existing(job_id: Id, session: ReadSession) -> str:
    return repository.get(session, job_id).id


ExistingJob = Annotated[str, Depends(_existing, scope="function")]


FeedDep = Annotated[Feed, Depends(part("feed"))]


async def _limit_connections(
    streams: Annotated[ConnectionLimit, Depends(part("streams"))], who: Reader
) -> AsyncIterator[None]:
    with streams.hold(who):
        yield


@router.get(
    "/{job_id}/events",
    response_class=EventSourceResponse,
    summary="Watch a job",
    responses=problems(404, 422),
    dependencies=[Depends(_limit_connections)],
)
async def events(
    job_id: ExistingJob,
    feed: FeedDep,
    who: Reader,
    last_event_id: Annotated[Position, Header(description="go on after this event")] = 0,
) -> AsyncIterator[ServerSentEvent]:
    """Server-sent events: `state` (state, attempt, error) and `progress`, from the beginning.

    The stream ends after a final state.
    """
    async for event in feed.follow(job_id, last_event_id, who.key_id):
        yield ServerSentEvent(id=str(event.id), event=event.kind, data=event.data)


@router.get("/{job_id}/log", summary="Read a job's log", responses=problems(404, 422))
def log(
    job_id: Id,
    session: ReadSession,
    after: Position = 0,
    limit: Limit = 1000,
    tail: Annotated[
        int | None, Query(ge=1, le=1000, description="only so many, the last ones")
    ] = None,
) -> LogView:
    """Read what the solver printed, by line, after line `after`."""
    repository.get(session, job_id)
    lines: Any = (
        repository.log(session, job_id, after, limit)
        if tail is None
        else repository.log_tail(session, job_id, after, tail)
    )
    return LogView(lines=lines, next=lines[-1].number if lines else after)


async def _take_turn(
    places: Annotated[Places, Depends(part("frame_readers"))],
) -> AsyncIterator[None]:
    async with places.place():
        yield


@router.get(
    "/{job_id}/frames",
    summary="Read the frames of a sequence or simulation",
    responses=problems(404, 409, 410, 422, 503),
    dependencies=[Depends(_take_turn)],
)
def read_frames(
    job_id: Id,
    session: ReadSession,
    store: ReadStore,
    who: Reader,
    reads: ReadsDep,
    start: Position = 0,
    limit: Limit = 100,
) -> FramesView:
    """Read the frames that are ready, from the `start`-th (0 is the first), also while it runs.

    They stay when the job fails or is canceled.
    """
    found = service.read_frames(session, store, job_id, start, limit)
    if found.frames:
        reads.note(who, "job.frames_read", job_id)
    return found


@router.get(
    "/{job_id}/frames/picture",
    summary="See the newest frame of a simulation",
    response_class=Response,
    responses={
        200: {"content": {"image/jpeg": {}}},
        204: {"description": "No frame has a picture yet"},
        **problems(404, 409, 410, 422, 503),
    },
    dependencies=[Depends(_take_turn)],
)
def read_picture(
    job_id: Id, session: ReadSession, store: ReadStore, who: Reader, reads: ReadsDep
) -> Response:
    """Read a small picture of the newest frame that has one, also while the job runs."""
    picture = service.newest_picture(session, store, job_id)
    if picture is None:
        return Response(status_code=204)
    reads.note(who, "job.frames_read", job_id)
    return Response(picture, media_type="image/jpeg", headers={"Cache-Control": "no-store"})


def _view(session: Session, job_id: str, settings: Settings) -> JobView:
    session.flush()
    job: Job = repository.get(session, job_id)
    name = subjects.names(session, [job.subject_id]).get(job.subject_id, "")
    place = positions(session, [job]).get(job.id)
    return JobView.of(job, name, place, own_days(session, settings))
