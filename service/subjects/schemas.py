"""What the API says about subjects."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from service.schemas import Body, Id, Title, View


class NewSubject(Body):
    """A person to be scanned."""

    name: Title = Field(examples=["Alex"])
    template_id: Id | None = Field(default=None, description="default: the built-in anatomy")


class SubjectView(View):
    """A person."""

    id: str
    name: str
    template_id: str | None
    created_at: datetime
