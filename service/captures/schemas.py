"""What the API says about captures."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from service.schemas import Body, Id, Name, View

Role = Literal["neutral", "expression"]


class NewCapture(Body):
    """A scan, as the file of a complete upload."""

    name: Name = Field(examples=["smile"])
    role: Role
    upload_id: Id


class CaptureView(View):
    """A named scan of a subject."""

    id: str
    subject_id: str
    name: str
    role: Role
    filename: str
    size: int
    sha256: str
    created_at: datetime
