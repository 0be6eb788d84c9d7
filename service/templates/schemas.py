"""What the API says about templates."""

from __future__ import annotations

from datetime import datetime

from service.schemas import Body, Id, Title, View


class NewTemplate(Body):
    """A template anatomy, as the file of a complete upload."""

    name: Title
    upload_id: Id


class TemplateView(View):
    """A template anatomy."""

    id: str
    name: str
    filename: str
    size: int
    sha256: str
    created_at: datetime
