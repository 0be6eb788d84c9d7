"""Fit photographs.

Weights of the template's shapes, a jaw and cameras for every photograph: first by landmarks, then
by the light on the skin, through flesh that keeps its volume and lips that meet. Photographs of
one moment are fitted together. The new rig is the parent, or without one the model as it was built,
with these expressions in its system of muscle tracks; pictures show how far plate and face agree,
and photo.npz has cameras, light, colours and landmarks in full precision. A film is fitted frame
after frame, and leaves a sequence instead; its frames can be read while the job runs.
"""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from solver.kinds.document import Name, Whole
from solver.kinds.kind import Box, Kind, LinearSolver, SequenceOptions

Moment = Annotated[list[str], Field(min_length=1, max_length=16)]


class FitPhoto(SequenceOptions):
    """Options of a fit to photographs; frames and their rate are those of a film."""

    sequence: bool = Field(
        default=False,
        description="the pictures are a film, in the order of their names (2 before 10): each "
        "frame is fitted from the one before",
    )
    moments: dict[Name, Moment] = Field(
        default={},
        max_length=16,
        description="photographs that were taken at the same moment, by the name of the expression "
        "that they show; a photograph that is in none is an expression by itself, named as it is",
    )
    neutral: str | None = Field(
        default=None,
        description="a photograph of the neutral face in the same light: light and the skin's "
        "colours are taken from it. null: from each photograph itself",
    )
    boxes: dict[str, Box] = Field(
        default={},
        max_length=16,
        description="left, top, right and bottom, px, of the face that is meant, by photograph, "
        "where it shows several and their landmarks are found",
    )
    model: Literal["tracks", "shapes"] = Field(
        default="tracks",
        description="what is fitted: tracks, flesh under muscle tracks; shapes, plain blendshapes, "
        "the baseline",
    )
    shading: bool | None = Field(
        default=None,
        description="fit the light on the skin, too; false: landmarks alone, which a film has by "
        "default; null: as by default",
    )
    w_l: float = Field(
        default=3.0,
        ge=0,
        le=1e6,
        description="price of each weight, linear: shapes that a picture hardly tells stay out",
    )
    w_w: float = Field(
        default=0.5,
        ge=0,
        le=1e6,
        description="price of the weights' squares: a prior of standard deviation 1 / sqrt(w_w)",
    )
    w_j: float = Field(
        default=1e5,
        ge=0,
        le=1e6,
        description="the same of the jaw on top of the shapes', by rad^2 and mm^2: one picture "
        "hardly tells it from them",
    )
    max_iterations: Whole = Field(
        default=30, ge=1, le=500, description="Gauss-Newton iterations of each stage at most"
    )
    linear_solver: LinearSolver = None

    @field_validator("moments")
    @classmethod
    def _has_moments(cls, value: dict[str, Moment], info: ValidationInfo) -> dict[str, Moment]:
        if value and info.data.get("sequence"):
            message = "are of photographs: each frame of a film is a moment by itself"
            raise PydanticCustomError("no_moments", message)
        return value

    @property
    def by_shading(self) -> bool:
        """Whether the light on the skin is fitted."""
        return not self.sequence if self.shading is None else self.shading


READS = ("any_rig", "model", "template", "tracks", "photos")

KIND = Kind(
    queue="short",
    reads=READS,
    leaves="rig",
    report="report.json",
    result="rig.glb",
    folder="rig-new",
    options=FitPhoto,
    frames=True,
    hands_on=("sequence.npz",),
    variants=(
        (
            "sequence",
            Kind(
                queue="long",
                reads=READS,
                leaves="sequence",
                result="sequence.npz",
                options=FitPhoto,
                frames=True,
                hands_on=("sequence.npz",),
            ),
        ),
    ),
)
