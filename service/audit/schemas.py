"""What the API says about the audit log."""

from __future__ import annotations

from datetime import datetime

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
