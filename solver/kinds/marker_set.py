"""Marker sets: which label sits where on a person's face, as a JSON document.

Places and heights are in mm, in the model's frame: x to the subject's left, y up, z forward.
"""

from typing import Annotated, Literal

from pydantic import Field, Tag

from solver.kinds.document import Document, Vector, Whole, by_type, tell_forms

MOST_MARKERS = 1000  # of a set; a face has some hundreds
LONGEST_LABEL = 100  # characters

# What a marker rides on: `face` the skin, `head` the skull (a headband, a cap's brim), splints the
# teeth; `ignore` is no part of the face.
Part = Literal["face", "head", "upper_teeth", "lower_teeth", "ignore"]

Vertex = Annotated[Whole, Field(ge=0, le=10_000_000)]
Row = Annotated[list[Annotated[float, Field(ge=-1.01, le=1.01)]], Field(min_length=3, max_length=3)]


class SkinPoint(Document):
    """A point of the skin."""

    vertices: list[Vertex] = Field(
        min_length=3, max_length=3, description="the three skin vertices of a triangle"
    )
    weights: list[Annotated[float, Field(ge=0, le=1)]] = Field(
        min_length=3, max_length=3, description="their shares in the point; they sum to 1"
    )


class MarkerEntry(Document):
    """A marker."""

    label: str = Field(min_length=1, max_length=LONGEST_LABEL, description="as takes have it")
    part: Part = Field(default="face", description="what the marker rides on")
    at: Annotated[
        Annotated[SkinPoint, Tag("<skin>")] | Annotated[Vector, Tag("<place>")],
        tell_forms(
            by_type({dict: "<skin>", SkinPoint: "<skin>", list: "<place>"}),
            "is not a point of the skin or a place",
        ),
    ] = Field(
        default=[0.0, 0.0, 0.0],
        description="a point of the skin for `face`; for what rides on bone the marker's place on "
        "the person at rest, [x, y, z] in mm",
    )
    height_mm: float = Field(
        default=0.0, ge=-50, le=50, description="of the marker's centre over the skin"
    )
    sigma_mm: float = Field(
        default=0.5,
        ge=0.001,
        le=50,
        description="how surely its place is known, a standard deviation",
    )


class SessionEntry(Document):
    """Map of a take's coordinates, in mm, to the model's: scale * rotation x + shift."""

    scale: float = Field(default=1.0, ge=0.001, le=1e6)
    rotation: list[Row] = Field(
        min_length=3, max_length=3, description="rows of an orthogonal matrix; it may mirror"
    )
    shift_mm: list[Annotated[float, Field(ge=-1e7, le=1e7)]] = Field(min_length=3, max_length=3)


class MarkerSetDocument(Document):
    """A marker set; one serves all takes of a session."""

    format: Literal[1] = Field(default=1, description="of this document")
    model_sha256: str = Field(
        pattern="^[0-9a-f]{64}$", description="of the model whose skin it is bound to"
    )
    session: SessionEntry
    markers: list[MarkerEntry] = Field(min_length=1, max_length=MOST_MARKERS)
