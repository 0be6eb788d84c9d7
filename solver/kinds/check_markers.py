"""Check markers.

Whether a take of markers can be used: verdict, findings with label, frames and advice, and a
picture; with a rig also where each label sits on it.
"""

from pydantic import Field

from solver.kinds.document import FrameNumber
from solver.kinds.kind import JobOptions, Kind


class CheckMarkers(JobOptions):
    """Options of a check of markers."""

    neutral: FrameNumber | None = Field(
        default=None,
        description="frame, as the file counts, at which the face is at rest; null: a still "
        "second, that most like the person if there is one",
    )
    expression: str | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="expression of the rig that the face shows in these frames; null: it is at "
        "rest",
    )
    actor: bool = Field(
        default=False,
        description="the take is another person's than the rig, whose motion is carried over",
    )


KIND = Kind(
    queue="short",
    seconds=300,
    reads=("markers", "any_rig", "template"),
    leaves="marker_check",
    report="check.json",
    result="check.png",
    folder="check",
    hands_on=("markers.json",),
    options=CheckMarkers,
)
