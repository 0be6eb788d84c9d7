"""Routes of live sessions."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, Depends, Query, Request, Response, WebSocket
from sqlalchemy.exc import OperationalError

from service import paging
from service.access.principal import Principal, Reader, Scope, Writer, note_authenticated, require
from service.dependencies import (
    Cursor,
    Limit,
    ReadsDep,
    ReadSession,
    ReadStore,
    ReceivingStore,
    SettingsDep,
    WriteSession,
    WriteStore,
    part,
)
from service.errors import Problem, problems, render
from service.idempotency import Once
from service.jobs import repository as jobs
from service.live import service
from service.live.broker import LiveBroker, unreachable
from service.live.relay import RelayedClient, RelayOptions
from service.live.schemas import (
    NewSession,
    OpenedSession,
    SessionView,
    TakeRecording,
    TicketOrder,
    TicketView,
)
from service.live.tickets import Ticket, Tickets, address
from service.queue.states import State
from service.queue.wakeups import AWAY
from service.records.audit import record
from service.rigs.repository import artifact_of_job
from service.rigs.routes import FILE, limit_by_key, send_artifact
from service.schemas import Id, Page
from service.store.models import Job
from solver.kinds.live_session import VIEW_FILE

router = APIRouter(prefix="/v1/live", tags=["live"])

TicketsDep = Annotated[Tickets, Depends(part("tickets"))]
BrokerDep = Annotated[LiveBroker, Depends(part("live_broker"))]


@router.post("", status_code=201, summary="Open a live session", responses=problems(404, 409, 422))
def create(
    new: NewSession,
    store: WriteStore,
    session: WriteSession,
    who: Writer,
    once: Once,
    settings: SettingsDep,
    tickets: TicketsDep,
) -> OpenedSession:
    """Queue a session on a rig; its station connects to `url`, and waits there for `ready`.

    A worker's place is needed, as for any job: `state` says whether it has one.
    """
    if not once.is_answered(store, new):
        service.check(store, new)
    if (known := once.find_answered(session, new)) is None:
        job = service.open_session(session, new, settings.max_attempts)
        once.keep(session, job.id)
        record(session, who, "job.created", job.id)
        known = job.id
    session.flush()
    view = SessionView.of(service.get(session, known))
    ticket = _ticket(tickets, known, who, TicketOrder())
    return OpenedSession.model_validate(view.model_dump() | ticket.model_dump())


def _ticket(tickets: Tickets, session_id: str, who: Principal, order: TicketOrder) -> TicketView:
    ticket, until = tickets.make(session_id, who, watch=order.watch)
    return TicketView(ticket=ticket, url=address(session_id, ticket), expires_at=until)


@router.get(
    "", response_model=Page[SessionView], summary="List live sessions", responses=problems(422)
)
def index(
    session: ReadSession,
    rig_id: Annotated[Id | None, Query()] = None,
    state: Annotated[
        list[State] | None, Query(description="one of these; may be given several times")
    ] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """List sessions, newest first, those that are over as well."""
    found = jobs.newest(session, service.listed(rig_id, state), limit, cursor)
    items = [SessionView.of(job) for job in found.items]
    return paging.respond(Page[SessionView](items=items, next=found.next))


@router.get("/{session_id}", summary="Show a live session", responses=problems(404, 422))
def show(session_id: Id, session: ReadSession) -> SessionView:
    """Show a session's state."""
    return SessionView.of(service.get(session, session_id))


@router.post(
    "/{session_id}/tickets",
    status_code=201,
    summary="Make a ticket for a live session",
    responses=problems(404, 409, 422),
)
def make_ticket(
    session_id: Id,
    session: ReadSession,
    who: Reader,
    tickets: TicketsDep,
    wanted: TicketOrder | None = None,
) -> TicketView:
    """Make a ticket that opens one more connection: the station's in the place of its last one.

    Without `watch` the key needs the scope `write`.
    """
    order = wanted or TicketOrder()
    require(Scope.READ if order.watch else Scope.WRITE, who)
    service.require_open(session, session_id)
    return _ticket(tickets, session_id, who, order)


@router.delete("/{session_id}", summary="End a live session", responses=problems(404, 422))
async def end(session_id: Id, store: ReceivingStore, who: Writer, broker: BrokerDep) -> SessionView:
    """End a session and wait until its takes are stored; canceled is one that takes too long."""
    was_open = await service.end(store, broker, session_id)

    def finish() -> SessionView:
        if was_open:
            with store.write() as session:
                record(session, who, "live.ended", session_id)
        with store.read() as session:
            return SessionView.of(service.get(session, session_id))

    return await to_thread.run_sync(finish)


@router.put(
    "/{session_id}/recording",
    status_code=202,
    summary="Record a take of a live session",
    responses=problems(404, 409, 422, 503),
)
async def begin_take(
    session_id: Id, take: TakeRecording, store: ReceivingStore, _: Writer, broker: BrokerDep
) -> TakeRecording:
    """Have a session record a take; it says `recording`, or a `fault`, to all who are connected."""
    await service.tell(store, broker, session_id, {"record": take.name})
    return take


@router.delete(
    "/{session_id}/recording",
    status_code=202,
    summary="End a take of a live session",
    responses=problems(404, 409, 422, 503),
)
async def end_take(session_id: Id, store: ReceivingStore, _: Writer, broker: BrokerDep) -> None:
    """Have a session end its take; it says `take` to all who are connected."""
    await service.tell(store, broker, session_id, {"stop": True})


@router.get(
    "/{session_id}/view",
    response_class=Response,
    summary="Download what a live session is drawn by",
    responses=FILE,
    dependencies=[Depends(limit_by_key)],
)
def view(
    session_id: Id,
    session: ReadSession,
    store: ReadStore,
    request: Request,
    who: Reader,
    reads: ReadsDep,
) -> Response:
    """Download the shapes of a session's skin, whose amounts its frames have.

    They are there a moment after the session is ready: docs/reference/live.md has their format.
    """
    artifact = artifact_of_job(session, service.get(session, session_id).id, VIEW_FILE)
    return send_artifact(artifact, store, request, who, reads)


@router.websocket("/{session_id}/frames")
async def frames(socket: WebSocket, session_id: str, ticket: str = "") -> None:
    """Connect to a session, as docs/reference/live.md has it."""
    with ExitStack() as held:
        try:
            connection = await _admit(socket, session_id, ticket, held)
        except Problem as problem:
            await socket.send_denial_response(render(socket.state.request_id, problem))
            return
        await socket.accept()
        await connection.serve()


async def _admit(socket: WebSocket, session_id: str, given: str, held: ExitStack) -> RelayedClient:
    """Return the connection that a ticket opens, counted as long as ``held`` is open."""
    state = socket.app.state
    tickets: Tickets = state.tickets
    broker: LiveBroker = state.live_broker
    ticket = tickets.verify(session_id, given, socket.state.request_id)
    who = ticket.who
    note_authenticated(socket, who.tenant_id)
    await to_thread.run_sync(state.rates.check, who.key_id, who.tenant_id)
    held.enter_context(state.live_connections.hold(who))
    try:
        await to_thread.run_sync(_require_open, socket, ticket)
        if not await broker.use(ticket.nonce, tickets.seconds):
            raise Problem(403, "ticket.used", "the ticket has been used: ask for another")
        options = RelayOptions(sends=state.settings.send_timeout)
        own = state.store.of(who.tenant_id)
        connection = RelayedClient(socket, ticket, broker, own, options)
        await connection.take_seat()
    except AWAY as error:
        raise unreachable() from error
    except OperationalError as error:
        detail = "the database does not answer; try again"
        raise Problem(503, "database.unreachable", detail) from error
    reads: ReadsDep = state.reads
    reads.note(who, "live.joined" if ticket.is_station else "live.watched", session_id)
    return connection


def _require_open(socket: WebSocket, ticket: Ticket) -> Job:
    with socket.app.state.store.of(ticket.who.tenant_id).read() as session:
        return service.require_open(session, ticket.session_id)
