"""Fit photographs.

Weights of the template's shapes, a jaw and cameras for every photograph: first by landmarks, then
by the light on the skin, through flesh that keeps its volume and lips that meet. Photographs of
one moment are fitted together. The new rig is the parent with these expressions in its system of
muscle tracks; pictures show how far plate and face agree.
"""

from typing import Annotated, Literal

from pydantic import Field

from solver.kinds.document import Name, Whole
from solver.kinds.kind import Box, JobOptions, Kind, LinearSolver

Moment = Annotated[list[str], Field(min_length=1, max_length=16)]


class FitPhoto(JobOptions):
    """Options of a fit to photographs."""

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
    shading: bool = Field(
        default=True, description="fit the light on the skin, too; false: landmarks alone"
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


KIND = Kind(
    queue="short",
    reads=("rig", "template", "tracks", "photos"),
    leaves="rig",
    report="report.json",
    result="rig.glb",
    folder="rig-new",
    options=FitPhoto,
)
