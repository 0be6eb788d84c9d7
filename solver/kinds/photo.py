"""What is known of a photograph beside its pixels, as a JSON document: its facts.

Places are pixels of the upright picture (turned as its EXIF says), column and row from its top left
corner, the middle of the first pixel being (0.5, 0.5). The camera is OpenCV's: x right, y down, z
into the picture, its place and everything else in mm.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, Tag, field_validator, model_validator
from pydantic_core import PydanticCustomError

from solver.kinds.document import Document, Whole, by_type, tell_forms

MEDIAPIPE_POINTS = (478, 468)  # of MediaPipe's face mesh, with irises and without
IBUG_POINTS = 68  # of the scheme of iBUG's 300-W
MOST_LANDMARKS = 1000  # with names, in a document
MOST_CURVE_POINTS = 400  # of each curve

Pixels = Annotated[float, Field(ge=-1e6, le=1e6)]
Pixel = Annotated[list[Pixels], Field(min_length=2, max_length=2)]
Curve = Annotated[list[Pixel], Field(min_length=3, max_length=MOST_CURVE_POINTS)]
ByName = Annotated[dict[str, Pixel], Field(min_length=1, max_length=MOST_LANDMARKS)]
Landmarks = Annotated[
    Annotated[ByName, Tag("<names>")] | Annotated[list[Pixel | None], Tag("<list>")],
    tell_forms(by_type({dict: "<names>", list: "<list>"}), "is not an object or a list of points"),
]
Focal = Annotated[float, Field(ge=1, le=1e7)]
Row = Annotated[list[Annotated[float, Field(ge=-1.01, le=1.01)]], Field(min_length=3, max_length=3)]


class CameraEntry(Document):
    """A calibrated camera."""

    fx: Focal = Field(description="focal length by a pixel's width, px")
    fy: Focal = Field(description="the same by its height")
    cx: Pixels | None = Field(default=None, description="principal point; null: the middle")
    cy: Pixels | None = Field(default=None, description="the same, down")
    distortion: list[Annotated[float, Field(ge=-1e4, le=1e4)]] = Field(
        default=[0.0] * 5,
        min_length=5,
        max_length=5,
        description="k1, k2, p1, p2, k3 (Brown 1971), as OpenCV has them",
    )
    rotation: list[Row] | None = Field(
        default=None,
        min_length=3,
        max_length=3,
        description="rows of a rotation: a point X of the world is R X + t to the camera. null: "
        "the world is the camera's own, and nobody knows where the head is in it",
    )
    translation: list[Annotated[float, Field(ge=-1e6, le=1e6)]] | None = Field(
        default=None, min_length=3, max_length=3, description="t, mm; beside a rotation"
    )

    @model_validator(mode="after")
    def _is_placed(self) -> CameraEntry:
        if (self.rotation is None) != (self.translation is None):
            message = "has one of rotation and translation: give both or none"
            raise PydanticCustomError("half_a_place", message)
        return self


class CurvesEntry(Document):
    """Outlines that were traced; left is the subject's.

    A curve is closed if its last point is its first, and open where a part of it is hidden.
    """

    lips_outer: Curve | None = Field(default=None, description="where lips end and skin begins")
    lips_inner: Curve | None = Field(
        default=None, description="where lips meet, or the mouth opens"
    )
    eye_left: Curve | None = Field(default=None, description="margins of the left eye's lids")
    eye_right: Curve | None = Field(default=None, description="margins of the right eye's lids")


class PhotoDocument(Document):
    """The facts of one photograph; every one may be left out."""

    format: Literal[1] = Field(default=1, description="of this document")
    size: list[Annotated[Whole, Field(ge=1)]] | None = Field(
        default=None,
        min_length=2,
        max_length=2,
        description="width and height of the upright picture that the places are of, which must "
        "be those of the file",
    )
    camera: CameraEntry | None = Field(default=None, description="not given: it is found")
    landmarks: Landmarks | None = Field(
        default=None,
        description="places by name, those of the template or numbers of MediaPipe's mesh (`0` to "
        "`477`); or the list of 478 of that mesh, or of 68 as iBUG orders them, with null where a "
        "point is not seen. Not given: they are found",
    )
    curves: CurvesEntry = Field(default=CurvesEntry(), description="outlines that were traced")

    @field_validator("landmarks")
    @classmethod
    def _is_a_scheme(cls, value: Landmarks | None) -> Landmarks | None:
        known = (*MEDIAPIPE_POINTS, IBUG_POINTS)
        if isinstance(value, list) and len(value) not in known:
            message = "has {count} points: lists of 478, 468 (MediaPipe) and 68 (iBUG) are known"
            raise PydanticCustomError("no_scheme", message, {"count": len(value)})
        return value
