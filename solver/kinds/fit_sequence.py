"""Fit a performance.

Activations and jaw of every frame of a performance with the rig's muscle weights, within the limits
that it was fitted in, each frame from the one before; frames can be read while the job runs.
"""

from typing import Annotated

from pydantic import Field

from solver.kinds.document import Integral, Whole
from solver.kinds.kind import FitOptions, Kind, LinearSolver


class FitSequence(FitOptions):
    """Options of a fit of frames."""

    fps: float = Field(
        default=30.0, ge=0.01, le=1000, description="frames of the performance per second"
    )
    start: Whole = Field(default=0, ge=0, description="first frame to fit")
    end: Annotated[int, Field(ge=1), Integral] | None = Field(
        default=None, description="the frame after the last to fit; null: all to the end"
    )
    step: Whole = Field(default=1, ge=1, description="fit every frame, every second ...")
    temporal: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="weight of the activations' change from frame to frame, beside 0.001 for "
        "their size, not a time as of fit_markers; 0: none",
    )
    head_motion: bool = Field(
        default=False, description="solve the rigid motion of the head and take it out"
    )
    max_iterations: Whole = Field(
        default=12, ge=1, le=500, description="Gauss-Newton iterations per frame at most"
    )
    linear_solver: LinearSolver = None


KIND = Kind(
    queue="long",
    reads=("rig", "performance", "activations"),
    leaves="sequence",
    result="sequence.npz",
    hands_on=("sequence.npz",),
    options=FitSequence,
    frames=True,
)
