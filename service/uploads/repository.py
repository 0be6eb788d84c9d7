"""The table of uploads."""

from __future__ import annotations

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from service.errors import Problem, not_found
from service.store.database import clock
from service.store.models import Upload
from service.store.tenancy import own_tenant


def get(session: Session, upload_id: str) -> Upload:
    """Return an upload that is still there."""
    upload = session.get(Upload, upload_id)
    if upload is None:
        raise not_found("upload", upload_id)
    if upload.expires_at < clock(session):
        raise Problem(410, "upload.expired", "the upload has expired", upload_id=upload_id)
    return upload


def get_complete(session: Session, upload_id: str) -> Upload:
    """Return an upload whose bytes have all arrived."""
    upload = get(session, upload_id)
    if not upload.complete:
        raise Problem(
            409,
            "upload.incomplete",
            f"{upload.filename}: {upload.offset} of {upload.size} bytes have arrived",
            upload_id=upload_id,
            file=upload.filename,
            expected=upload.size,
            found=upload.offset,
        )
    return upload


def use(session: Session, upload: Upload, object_id: str) -> None:
    """Note what an upload was used for: it is forgotten with that, if it is still there then."""
    session.execute(update(Upload).where(Upload.id == upload.id).values(used_by=object_id))


def unfinished_ids(session: Session) -> set[str]:
    """Return the ids of the uploads that still have bytes of their own."""
    return set(session.scalars(select(Upload.id).where(~Upload.complete)))


def count_open(session: Session) -> int:
    """Count the session's tenant's unfinished uploads; until the commit nobody else counts them."""
    own_tenant(session, lock=True)
    unfinished = select(func.count(Upload.id)).where(
        ~Upload.complete, Upload.expires_at >= clock(session)
    )
    return session.execute(unfinished).scalar_one()
