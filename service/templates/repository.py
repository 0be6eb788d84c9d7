"""The table of templates."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.store.models import Subject, Template


def get(session: Session, template_id: str) -> Template:
    """Return a template."""
    template = session.get(Template, template_id)
    if template is None:
        raise not_found("template", template_id)
    return template


def hold(session: Session, template_id: str) -> Template:
    """Return a template that nobody can delete until the commit."""
    share = {"read": True, "key_share": True}
    template = session.get(Template, template_id, with_for_update=share)
    if template is None:
        raise not_found("template", template_id)
    return template


def lock(session: Session, template_id: str) -> Template:
    """Return a template that no subject can be given until the commit."""
    template = session.get(Template, template_id, with_for_update=True)
    if template is None:
        raise not_found("template", template_id)
    return template


def subjects_of(session: Session, template_id: str) -> Sequence[str]:
    """Return the ids of subjects that have a template, a few of them."""
    return session.scalars(
        select(Subject.id).where(Subject.template_id == template_id).limit(10)
    ).all()


def newest(session: Session, limit: int, cursor: str | None) -> Slice[Template]:
    """Return templates, newest first."""
    return paging.newest(session, select(Template), limit, cursor)
