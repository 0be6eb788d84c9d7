"""A rig's preview is made by a job of its own, but stays and goes with the rig."""

from __future__ import annotations

from sqlalchemy import ColumnElement, and_
from sqlalchemy.orm import InstrumentedAttribute

from service.store.models import Job

KIND = "build_preview"
FILE = "preview.bin"


def of_rig(rig_id: str | InstrumentedAttribute[str]) -> ColumnElement[bool]:
    """Tell which jobs make a rig's preview."""
    return and_(Job.kind == KIND, Job.request["rig_id"].as_string() == rig_id)
