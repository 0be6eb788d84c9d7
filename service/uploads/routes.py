"""Routes of uploads: tus 1.0 with creation, expiration, checksum and termination."""

from __future__ import annotations

from email.utils import format_datetime
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Request, Response

from service.access.principal import Scope, need_scope
from service.dependencies import BallastDep, ReceivingStore, SettingsDep, WriteStore, part
from service.errors import CHECKSUM_MISMATCH, Problem, problems
from service.schemas import Id, Position
from service.store.models import Upload
from service.uploads.schemas import UploadView, parse_checksum, parse_metadata
from service.uploads.service import UploadService
from service.writers import Places

VERSION = "1.0.0"
ALGORITHMS = ("sha256", "sha1")
CONTENT_TYPE = "application/offset+octet-stream"
OTHER_EXTENSIONS = ("upload-defer-length", "upload-concat")


def _speaks_tus(response: Response, tus_resumable: Annotated[str | None, Header()] = None) -> None:
    """Refuse other versions of the protocol; a client that names none is taken at its word."""
    response.headers["Tus-Resumable"] = VERSION
    if tus_resumable not in (None, VERSION):
        problem = Problem(412, "upload.version", "unknown tus version", found=tus_resumable)
        problem.headers = {"Tus-Version": VERSION}
        raise problem


async def _creation_only(request: Request) -> None:
    """Refuse what belongs to extensions that this service does not have, instead of ignoring it."""
    asked = [name for name in OTHER_EXTENSIONS if name in request.headers]
    if not asked and await request.body():
        asked = ["creation-with-upload"]
    if asked:
        raise Problem(
            400,
            "upload.extension",
            f"{asked[0]} is not supported: announce the whole length, then send bytes by PATCH",
            found=asked[0],
        )


def _service(store: WriteStore, settings: SettingsDep) -> UploadService:
    return UploadService(store, settings)


Service = Annotated[UploadService, Depends(_service)]
Length = Annotated[int, Header(alias="Upload-Length", ge=0, lt=2**63, description="size in bytes")]
Offset = Annotated[Position, Header(alias="Upload-Offset", description="where to go on")]
Metadata = Annotated[
    str,
    Header(
        alias="Upload-Metadata",
        description="`filename <base64>` and, to have the whole file checked, `sha256 <base64>`",
    ),
]
ChunkChecksum = Annotated[
    str | None, Header(alias="Upload-Checksum", description="`sha256 <base64>` of these bytes")
]

router = APIRouter(
    prefix="/v1/uploads",
    tags=["uploads"],
    dependencies=[Depends(need_scope(Scope.WRITE)), Depends(_speaks_tus)],
)


def _headers(response: Response, upload: Upload) -> None:
    response.headers["Upload-Offset"] = str(upload.offset)
    response.headers["Upload-Length"] = str(upload.size)
    response.headers["Upload-Expires"] = format_datetime(upload.expires_at, usegmt=True)


@router.options(
    "", status_code=204, summary="What the upload protocol can do", responses=problems(412, 422)
)
def describe(response: Response, settings: SettingsDep) -> None:
    """Show version, extensions, checksum algorithms and the largest size."""
    response.headers["Tus-Version"] = VERSION
    response.headers["Tus-Extension"] = "creation,expiration,checksum,termination"
    response.headers["Tus-Checksum-Algorithm"] = ",".join(ALGORITHMS)
    response.headers["Tus-Max-Size"] = str(settings.max_upload_bytes)


@router.post(
    "",
    status_code=201,
    summary="Start an upload",
    dependencies=[Depends(_creation_only)],
    responses=problems(400, 408, 412, 413, 422, 429),
)
def create(response: Response, service: Service, length: Length, metadata: Metadata) -> UploadView:
    """Announce a file; send its bytes with `PATCH` to the `Location`."""
    filename, sha256 = parse_metadata(metadata)
    upload = service.create(filename, length, sha256)
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    _headers(response, upload)
    return UploadView.of(upload)


@router.get("/{upload_id}", summary="Show an upload", responses=problems(404, 410, 412, 422))
def show(upload_id: Id, service: Service) -> UploadView:
    """Show how much has arrived."""
    return UploadView.of(service.get(upload_id))


@router.head(
    "/{upload_id}",
    summary="Ask where to go on",
    responses=problems(404, 410, 412, 422, 423, CHECKSUM_MISMATCH),
)
def offset(upload_id: Id, service: Service, response: Response) -> None:
    """Show the offset of the next byte; 423 while another request is still writing."""
    _headers(response, service.settle(upload_id))
    response.headers["Cache-Control"] = "no-store"


@router.patch(
    "/{upload_id}",
    status_code=204,
    summary="Send bytes",
    responses=problems(400, 404, 408, 409, 410, 412, 413, 415, 422, 423, CHECKSUM_MISMATCH, 507),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {CONTENT_TYPE: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def receive(
    upload_id: Id,
    request: Request,
    response: Response,
    store: ReceivingStore,
    settings: SettingsDep,
    writers: Annotated[Places, Depends(part("writers"))],
    offset: Offset,
    checksum: ChunkChecksum = None,
) -> None:
    """Append bytes at `Upload-Offset`; the last ones complete the upload and check its sha256."""
    if request.headers.get("content-type") != CONTENT_TYPE:
        raise Problem(415, "upload.content_type", f"send bytes as {CONTENT_TYPE}")
    expected = parse_checksum(checksum, ALGORITHMS)
    service = UploadService(store, settings)
    received = await service.receive(upload_id, offset, expected, request.stream(), writers)
    _headers(response, received)


@router.delete(
    "/{upload_id}",
    status_code=204,
    summary="Give an upload up",
    responses=problems(404, 409, 410, 412, 422, 423),
)
def delete(upload_id: Id, service: Service, ballast: BallastDep) -> None:
    """Forget an upload; captures made from it stay. 423 while another request is writing."""
    ballast.drop()
    service.delete(upload_id)
