"""Routes of rigs and artifacts."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import FileResponse

from service.access.principal import Reader
from service.access.signed import Signer
from service.audit.record import record
from service.dependencies import Cursor, FileStore, Limit, ReadSession, ReadStore, SettingsDep
from service.errors import problems
from service.rigs import repository
from service.rigs.download import Download
from service.rigs.schemas import RigView, SignedUrl
from service.schemas import FileName, Id, Page
from service.store.models import Artifact
from service.store.store import Store

router = APIRouter(prefix="/v1", tags=["rigs"])


def _signer(request: Request) -> Signer:
    signer: Signer = request.app.state.signer
    return signer


Signing = Annotated[Signer, Depends(_signer)]
IfNoneMatch = Annotated[str | None, Header()]
PAGE = "text/html"
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-downloads"
"""What a stored page may do in a browser: show itself, and nothing with this origin's name."""

FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {"*/*": {}}},
    206: {"description": "A range of the file"},
    304: {"description": "The caller's copy is the file"},
    **problems(400, 404, 416, 422),
}


@router.get("/rigs", summary="List rigs", responses=problems(422))
def index(
    session: ReadSession,
    settings: SettingsDep,
    subject_id: Annotated[Id | None, Query()] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[RigView]:
    """List rigs, newest first."""
    found = repository.newest(session, subject_id, limit, cursor)
    return Page(items=[RigView.of(rig, settings) for rig in found.items], next=found.next)


@router.get("/rigs/{rig_id}", summary="Show a rig", responses=problems(404, 422))
def show(rig_id: Id, session: ReadSession, settings: SettingsDep) -> RigView:
    """Show a rig's expressions, figures and files."""
    return RigView.of(repository.get(session, rig_id), settings)


@router.get(
    "/rigs/{rig_id}/artifacts/{name}",
    response_class=FileResponse,
    summary="Download a rig's file by name",
    responses=FILE,
)
def download_by_name(
    rig_id: Id,
    name: FileName,
    session: ReadSession,
    store: ReadStore,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Download for example `rig.glb`; `Range` and `If-None-Match` work."""
    rig = repository.get(session, rig_id)
    return _file(repository.artifact_of_job(session, rig.job_id, name), store, if_none_match)


@router.head(
    "/artifacts/{artifact_id}",
    response_class=Response,
    summary="Ask about a file",
    responses=FILE,
)
@router.get(
    "/artifacts/{artifact_id}",
    response_class=FileResponse,
    summary="Download a file",
    responses=FILE,
)
def download(artifact_id: Id, store: FileStore, if_none_match: IfNoneMatch = None) -> Response:
    """Download an artifact, with a key or by a signed URL.

    It never changes: `If-None-Match` spares who has it the bytes.
    """
    with store.read() as session:
        artifact = repository.artifact(session, artifact_id)
    return _file(artifact, store, if_none_match)


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


def _file(artifact: Artifact, store: Store, if_none_match: str | None) -> Response:
    headers = {
        "ETag": f'"{artifact.sha256}"',
        "Cache-Control": "private, no-cache",  # what is deleted must not live on there
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": POLICY,
    }
    known = {tag.strip().removeprefix("W/") for tag in (if_none_match or "").split(",")}
    if known & {headers["ETag"], "*"}:
        return Response(status_code=304, headers=headers)
    return Download(
        store.files.path(artifact.sha256),
        headers=headers,
        media_type=artifact.media_type,
        filename=artifact.name,
        content_disposition_type="inline" if artifact.media_type == PAGE else "attachment",
    )
