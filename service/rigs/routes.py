"""Routes of rigs and artifacts."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from datetime import UTC, datetime
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from sqlalchemy.orm import Session

from service import paging
from service.access.limits import ConnectionLimit
from service.access.principal import Principal, Reader, Writer
from service.access.signed import FileReader, Signer
from service.dependencies import (
    Cursor,
    FileStore,
    Limit,
    ReadsDep,
    ReadSession,
    ReadStore,
    SettingsDep,
    WithLabels,
    WriteSession,
    part,
)
from service.errors import problems
from service.records.audit import ReadLog, record
from service.rigs import repository
from service.rigs.archive import archive_of
from service.rigs.download import StoredArtifact, send
from service.rigs.schemas import ArtifactView, RigChange, RigItem, RigView, SignedUrl
from service.schemas import FileName, Id, Page
from service.settings import Settings
from service.store.database import Store
from service.store.models import Artifact, Rig
from service.store.retention import own_days
from service.subjects.service import relabel

router = APIRouter(prefix="/v1", tags=["rigs"])


FILES_OF_0_1 = ("activations.npz", "muscle_weights.npz")
# RFC 9745: since when, in seconds of the epoch (2026-11-22)
FILES_DEPRECATED = "@1795305600"

Signing = Annotated[Signer, Depends(part("signer"))]
Downloads = Annotated[ConnectionLimit, Depends(part("downloads"))]


async def _limit_connections(downloads: Downloads, who: FileReader) -> AsyncIterator[None]:
    with downloads.hold(who):
        yield


async def limit_by_key(downloads: Downloads, who: Reader) -> AsyncIterator[None]:
    """Let a key download so many files at a time."""
    with downloads.hold(who):
        yield


FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {"*/*": {}}},
    206: {"description": "A range of the file"},
    304: {"description": "The caller's copy is the file"},
    **problems(404, 410, 416, 422),
}


@router.get("/rigs", response_model=Page[RigItem], summary="List rigs", responses=problems(422))
def index(
    session: ReadSession,
    settings: SettingsDep,
    subject_id: Annotated[Id | None, Query()] = None,
    label: WithLabels = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Response:
    """List rigs, newest first, in short; each one's own path has its files and all figures."""
    found = repository.newest(session, subject_id, label, limit, cursor)
    kept = own_days(session, settings)
    items = [RigItem.of(row, kept) for row in repository.rows(session, found.items)]
    return paging.respond(Page[RigItem](items=items, next=found.next))


@router.get("/rigs/{rig_id}", summary="Show a rig", responses=problems(404, 422))
def show(rig_id: Id, session: ReadSession, settings: SettingsDep) -> RigView:
    """Show a rig's expressions, figures and files, `preview.bin` among them once it is made."""
    return _view(session, repository.get(session, rig_id), settings)


@router.patch("/rigs/{rig_id}", summary="Change a rig", responses=problems(404, 422))
def change(
    rig_id: Id, order: RigChange, session: WriteSession, who: Writer, settings: SettingsDep
) -> RigView:
    """Give a rig a name or other labels; its files stay as they are."""
    rig = repository.lock(session, rig_id)
    rig.name = rig.name if order.name is None else order.name
    relabel(rig, order.labels)
    record(session, who, "rig.changed", rig_id)
    return _view(session, rig, settings)


def _view(session: Session, rig: Rig, settings: Settings) -> RigView:
    view = RigView.of(repository.rows(session, [rig])[0], own_days(session, settings))
    if preview := repository.preview(session, rig):
        view.artifacts.append(ArtifactView.model_validate(preview))
    return view


@router.head(
    "/rigs/{rig_id}/artifacts/{name}",
    response_class=Response,
    summary="Ask about a rig's file by name",
    responses=FILE,
    dependencies=[Depends(limit_by_key)],
)
@router.get(
    "/rigs/{rig_id}/artifacts/{name}",
    response_class=Response,
    summary="Download a rig's file by name",
    responses=FILE,
    dependencies=[Depends(limit_by_key)],
)
def download_by_name(
    rig_id: Id,
    name: FileName,
    session: ReadSession,
    store: ReadStore,
    request: Request,
    who: Reader,
    reads: ReadsDep,
) -> Response:
    """Download for example `rig.npz`; `Range`, `If-Range` and `If-None-Match` work.

    `activations.npz` and `muscle_weights.npz` beside a `rig.npz` are deprecated: it holds both.
    """
    rig = repository.get(session, rig_id)
    artifact = repository.artifact_of_rig(session, rig, name)
    response = send_artifact(artifact, store, request, who, reads)
    if name in FILES_OF_0_1 and any(each.name == repository.RIG_FILE for each in rig.artifacts):
        whole = f"/v1/rigs/{rig.id}/artifacts/{repository.RIG_FILE}"
        response.headers["Deprecation"] = FILES_DEPRECATED
        response.headers["Link"] = f'<{whole}>; rel="successor-version"'
    return response


@router.head(
    "/rigs/{rig_id}/archive",
    response_class=Response,
    summary="Ask about a rig's archive",
    responses=FILE,
    dependencies=[Depends(limit_by_key)],
)
@router.get(
    "/rigs/{rig_id}/archive",
    response_class=Response,
    summary="Download a rig whole",
    responses=FILE,
    dependencies=[Depends(limit_by_key)],
)
def download_archive(
    rig_id: Id, store: ReadStore, request: Request, who: Reader, reads: ReadsDep
) -> Response:
    """Download a rig with its model and, of a template of your own, that: one ZIP file.

    `rig.json` in it says whose rig it is, of which template, and names the job, the size and the
    sha256 of each file. Its own sha256 is the `ETag`: `Range`, `If-Range` and `If-None-Match` work.
    """
    with store.read() as session:
        archive = archive_of(session, repository.get(session, rig_id), store)
    response = send(archive, request)
    _note(response, request, reads, (who, "rig.downloaded", rig_id))
    return response


@router.head(
    "/artifacts/{artifact_id}",
    response_class=Response,
    summary="Ask about a file",
    responses=FILE,
    dependencies=[Depends(_limit_connections)],
)
@router.get(
    "/artifacts/{artifact_id}",
    response_class=Response,
    summary="Download a file",
    responses=FILE,
    dependencies=[Depends(_limit_connections)],
)
def download(
    artifact_id: Id, store: FileStore, request: Request, who: FileReader, reads: ReadsDep
) -> Response:
    """Download an artifact, with a key or by a signed URL.

    It never changes: `If-None-Match` spares who has it the bytes.
    """
    with store.read() as session:
        artifact = repository.artifact(session, artifact_id)
    return send_artifact(artifact, store, request, who, reads)


def send_artifact(
    artifact: Artifact, store: Store, request: Request, who: Principal, reads: ReadLog
) -> Response:
    """Send a job's file, and note that it was read."""
    response = send(StoredArtifact.of(artifact, store), request)
    _note(response, request, reads, (who, "artifact.downloaded", artifact.id))
    return response


def _note(
    response: Response, request: Request, reads: ReadLog, read: tuple[Principal, str, str]
) -> None:
    """Note a read, unless nothing was sent that the caller had not."""
    if request.method == "GET" and response.status_code != HTTPStatus.NOT_MODIFIED:
        reads.note(*read)


@router.post(
    "/artifacts/{artifact_id}/url",
    status_code=201,
    summary="Sign a URL of a file",
    responses=problems(404, 422),
)
def sign(
    artifact_id: Id, store: ReadStore, who: Reader, signer: Signing, settings: SettingsDep
) -> SignedUrl:
    """Make a URL that anybody can read the file by, without a key, for a few minutes."""
    with store.write() as session:
        artifact = repository.artifact(session, artifact_id)
        record(session, who, "artifact.signed", artifact.id)
    until = int(time.time()) + settings.signed_url_seconds
    url = signer.sign(f"/v1/artifacts/{artifact.id}", who.tenant_id, until)
    return SignedUrl(url=url, expires_at=datetime.fromtimestamp(until, UTC))
