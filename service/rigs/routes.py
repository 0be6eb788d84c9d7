"""Routes of rigs and artifacts."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import FileResponse

from service.dependencies import Cursor, Limit, ReadSession, ReadStore
from service.errors import problems
from service.rigs import repository
from service.rigs.download import Download
from service.rigs.schemas import ArtifactView, RigView
from service.schemas import FileName, Id, Page
from service.store.models import Artifact
from service.store.store import Store

router = APIRouter(prefix="/v1", tags=["rigs"])

IfNoneMatch = Annotated[str | None, Header()]
PAGE = "text/html"
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-downloads"
"""What a stored page may do in a browser: show itself, and nothing with this origin's name."""

FILE: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {"application/octet-stream": {}}},
    206: {"description": "A range of the file"},
    304: {"description": "The caller's copy is the file"},
    **problems(400, 404, 416, 422),
}


@router.get("/rigs", response_model=Page[RigView], summary="List rigs", responses=problems(422))
def index(
    session: ReadSession,
    subject_id: Annotated[Id | None, Query()] = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Any:
    """List rigs, newest first."""
    return repository.newest(session, subject_id, limit, cursor)


@router.get(
    "/rigs/{rig_id}", response_model=RigView, summary="Show a rig", responses=problems(404, 422)
)
def show(rig_id: Id, session: ReadSession) -> Any:
    """Show a rig's expressions, figures and files, `preview.bin` among them once it is made."""
    rig = repository.get(session, rig_id)
    view = RigView.model_validate(rig)
    if preview := repository.preview(session, rig):
        view.artifacts.append(ArtifactView.model_validate(preview))
    return view


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
    return _file(repository.artifact_of_rig(session, rig, name), store, if_none_match)


@router.get(
    "/artifacts/{artifact_id}",
    response_class=FileResponse,
    summary="Download a file",
    responses=FILE,
)
def download(
    artifact_id: Id, session: ReadSession, store: ReadStore, if_none_match: IfNoneMatch = None
) -> Response:
    """Download an artifact; it never changes, so a copy can be kept for ever."""
    return _file(repository.artifact(session, artifact_id), store, if_none_match)


def _file(artifact: Artifact, store: Store, if_none_match: str | None) -> Response:
    headers = {
        "ETag": f'"{artifact.sha256}"',
        "Cache-Control": "private, max-age=31536000, immutable",
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
