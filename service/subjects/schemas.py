"""Bodies and views of subjects."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from service.schemas import Change, Id, LabelChanges, Labels, RequestBody, RetainUntil, Title, View
from service.store import retention
from service.store.models import Subject


class NewSubject(RequestBody):
    """A person to be scanned."""

    name: Title = Field(examples=["Alex"])
    template_id: Id | None = Field(default=None, description="default: the built-in anatomy")
    labels: Labels = Field(default={})


class SubjectChange(Change):
    """Changes of a person; what is left out stays."""

    name: Title | None = None
    labels: LabelChanges | None = None


class SubjectView(View):
    """A person."""

    id: str
    name: str
    template_id: str | None
    labels: dict[str, str]
    created_at: datetime
    retain_until: RetainUntil

    @classmethod
    def of(cls, subject: Subject, kept: retention.Days) -> SubjectView:
        """Show a subject."""
        return cls(
            id=subject.id,
            name=subject.name,
            template_id=subject.template_id,
            labels=subject.labels,
            created_at=subject.created_at,
            retain_until=retention.until(kept.subjects, subject.created_at),
        )
