"""The table of templates."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from service import paging
from service.errors import unknown
from service.paging import Slice
from service.store.models import Template


def get(session: Session, template_id: str) -> Template:
    """Return a template."""
    template = session.get(Template, template_id)
    if template is None:
        raise unknown("template", template_id)
    return template


def newest(session: Session, limit: int, cursor: str | None) -> Slice[Template]:
    """Return templates, newest first."""
    return paging.newest(session, select(Template), limit, cursor)
