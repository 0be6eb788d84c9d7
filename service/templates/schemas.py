"""Bodies and views of templates."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from service.schemas import Id, RequestBody, Title, View


class NewTemplate(RequestBody):
    """A template anatomy, as the file of a complete upload."""

    name: Title
    upload_id: Id


class TemplateView(View):
    """A template anatomy."""

    id: str
    name: str
    vertices: int | None = Field(
        description="of its skin, as many as a registered scan has; null: they could not be "
        "counted, or it was uploaded before the service counted them"
    )
    filename: str
    size: int
    sha256: str
    created_at: datetime
