"""The recording that a scene plays: a file of it, and how it is read."""

from typing import Annotated, Literal

from pydantic import Field, Tag

from solver.kinds.document import Document, Integral, Whole, by_type, tell_forms

Gain = Annotated[float, Field(ge=0, le=10)]
NeutralFrame = Annotated[
    Annotated[Literal["auto"], Tag("<auto>")]
    | Annotated[int, Field(ge=0), Integral, Tag("<frame>")],
    tell_forms(
        by_type({str: "<auto>", int: "<frame>", float: "<frame>"}),
        "is not auto or a frame's number",
    ),
]
RecordingGain = Annotated[
    Annotated[Gain, Tag("<factor>")] | Annotated[Literal["range"], Tag("<range>")],
    tell_forms(
        by_type({str: "<range>", int: "<factor>", float: "<factor>"}), "is not range or a number"
    ),
]


class Recording(Document):
    """Frames of a recording."""

    asset: str = Field(
        description="a CSV file of Live Link Face or OpenFace, a video, or the signals of one"
    )
    start: Whole = Field(default=0, ge=0, description="first frame")
    end: Annotated[int, Field(ge=1), Integral] | None = Field(
        default=None, description="the frame after the last; null: to the end"
    )
    fps: float | None = Field(
        default=None, ge=1, le=1000, description="frames a second, in the place of the file's clock"
    )
    face: Annotated[int, Field(ge=0), Integral] | None = Field(
        default=None,
        description="whose face is played where there are several: its face_id (OpenFace), or its "
        "number in a video, 0 being the largest at the middle",
    )
    au_scale: float | None = Field(
        default=None,
        ge=0.1,
        le=100,
        description="the full intensity of an action unit; null: 5 (OpenFace)",
    )
    neutral: NeutralFrame = Field(
        default="auto",
        description="the frame in which the face is at rest, counted as start is, which is taken "
        "off; auto: what is low in the take, and nothing off one of Live Link Face",
    )
    gain: RecordingGain = Field(
        default=1.0,
        description="factor of all weights; range: each shape or action unit by its range in the "
        "take",
    )
    smooth_hz: float | None = Field(
        default=None,
        ge=0,
        le=100,
        description="faster motion is taken out, without delay; 0: nothing; null: above 6 of a "
        "video, nothing of others",
    )
    camera_pitch_deg: float | None = Field(
        default=None,
        ge=-90,
        le=90,
        description="how far the camera looked up: the head is turned as it was in the world; "
        "null: from where it is at rest",
    )
