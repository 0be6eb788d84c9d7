"""The table of templates."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.errors import unknown
from service.store.models import Template


def get(session: Session, template_id: str) -> Template:
    """Return a template."""
    template = session.get(Template, template_id)
    if template is None:
        raise unknown("template", template_id)
    return template


def newest(session: Session, limit: int) -> Sequence[Template]:
    """Return templates, newest first."""
    return session.scalars(select(Template).order_by(Template.created_at.desc()).limit(limit)).all()
