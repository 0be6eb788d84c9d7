"""What can be done with templates."""

from __future__ import annotations

from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.models import Template
from service.templates.schemas import NewTemplate
from service.uploads import repository as uploads


def create(session: Session, new: NewTemplate) -> Template:
    """Make a template of an upload; a worker reads the file when a model is built."""
    upload = uploads.get_complete(session, new.upload_id)
    if not upload.filename.lower().endswith(".npz"):
        raise Problem(
            422,
            "template.format",
            f"{upload.filename}: a template is an .npz file",
            file=upload.filename,
            expected=[".npz"],
        )
    template = Template(
        name=new.name,
        filename=upload.filename,
        size=upload.size,
        sha256=upload.sha256,
    )
    session.add(template)
    session.flush()
    return template
