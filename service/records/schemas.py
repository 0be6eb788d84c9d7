"""Views of the audit log and of deletions."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from service.schemas import View


class AuditEntryView(View):
    """An action; `request_id` is in the service's log, too."""

    id: str
    created_at: datetime
    key_id: str = Field(
        description="the key it was done with; `operator`: on the machine that has the data"
    )
    request_id: str
    action: str = Field(examples=["subject.deleted"])
    object_id: str = Field(description="the id of the subject, the key ... that it was about")


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
    files_at: datetime | None = Field(
        description="when its files were gone, too, but for those that others have"
    )
    read_by: list[str] = Field(
        description="jobs of the subject that stay and had read files of it, the newest 20: what "
        "they made stays as well"
    )
