"""What the API says about deletions."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from service.schemas import View


class DeletionView(View):
    """The receipt of a deletion: the object itself is not named, but by its id."""

    id: str
    kind: Literal["subject", "capture", "template", "rig", "job"]
    object_id: str
    reason: Literal["request", "retention"]
    created_at: datetime
    rows_at: datetime | None = Field(
        description="when nothing showed it any more; null: its jobs are being stopped"
    )
    files_at: datetime | None = Field(description="when its last file was gone, too")
