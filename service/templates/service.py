"""Template operations: create, delete."""

from __future__ import annotations

from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.deletion import delete_template
from service.store.models import Deletion, Template
from service.templates import repository
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
        name=new.name, filename=upload.filename, size=upload.size, sha256=upload.sha256
    )
    session.add(template)
    session.flush()
    uploads.use(session, upload, template.id)
    return template


def delete(session: Session, template_id: str) -> Deletion:
    """Delete a template that no subject has."""
    template = repository.lock(session, template_id)
    if subjects := repository.subjects_of(session, template_id):
        raise Problem(
            409,
            "template.in_use",
            "subjects have this template",
            template_id=template_id,
            subject_ids=list(subjects),
        )
    return delete_template(session, template, "request")
