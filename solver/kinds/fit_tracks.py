"""Fit muscle tracks.

Weights of the template's shapes and a jaw for every scan, through flesh that keeps its volume and
lips that meet. The new rig is the parent with these expressions beside those of its muscles, and
those of plain shapes and of single tets as well, if asked for; its report compares them.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from solver.kinds.document import Whole
from solver.kinds.kind import FitOptions, Kind, LinearSolver


class FitTracks(FitOptions):
    """Options of a fit of weights."""

    bounds: Literal["unit", "free"] = Field(
        default="unit",
        description="what weights may be: unit, from 0 to 1, where an animator can take them up; "
        "free, any numbers, as published",
    )
    w_w: float = Field(
        default=1e-4,
        ge=0,
        le=100,
        description="price of the weights, mm^2: one that is 1 costs as much as skin that is "
        "sqrt(w_w / 2) mm off everywhere, so that it grows as the square of a scan's noise",
    )
    w_j: float = Field(
        default=1e-4,
        ge=0,
        le=100,
        description="the same of the jaw on top of the shapes', by rad^2 and mm^2",
    )
    head: Literal["fixed", "placed"] = Field(
        default="fixed",
        description="fixed, where the scan has it, which is where registration brings it; placed, "
        "told from the face by the skin that lies still on the skull, so that a scan may lie "
        "turned and shifted. Only for weights: muscles and single tets take scans as they lie",
    )
    plain_shapes: bool = Field(
        default=False,
        description="fit plain blendshapes to the same scans, too: what tracks are compared with",
    )
    muscles: bool = Field(
        default=False,
        description="fit muscles to those of the scans that the rig has not, too, as "
        "fit_activations does by default",
    )
    per_tet: bool = Field(
        default=False,
        description="fit activations of single tets to the same scans, too: the model that muscle "
        "geometry is compared with; an expression takes minutes",
    )
    max_iterations: Whole = Field(
        default=20,
        ge=1,
        le=500,
        description="most Gauss-Newton iterations of an expression by weights, of tracks and plain "
        "shapes; fits by muscles and by single tets have their own",
    )
    linear_solver: LinearSolver = None

    @model_validator(mode="after")
    def _places_heads_of_weights_alone(self) -> FitTracks:
        if self.head == "placed" and (self.muscles or self.per_tet):
            message = "has head: placed beside muscles or per_tet, which place no head"
            raise PydanticCustomError("placed_head", message)
        return self


READS = ("rig", "captures", "tracks")

KIND = Kind(
    queue="short",
    reads=READS,
    leaves="rig",
    report="report.json",
    result="rig.glb",
    folder="rig-new",
    options=FitTracks,
    variants=(
        (
            "per_tet",
            Kind(
                queue="long",
                reads=READS,
                leaves="rig",
                report="report.json",
                result="rig.glb",
                options=FitTracks,
            ),
        ),
    ),
)
