"""Fit a performance.

Activations and jaw of every frame of a performance with the rig's muscle weights, within the limits
that it was fitted in, or weights of the shapes of its tracks, each frame from the one before;
frames can be read while the job runs.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import FitOptions, Kind, LinearSolver, SequenceOptions


class FitSequence(SequenceOptions, FitOptions):
    """Options of a fit of frames."""

    system: Literal["S", "T"] = Field(
        default="S",
        description="what is fitted: S, activations of the muscles; T, weights of the shapes of "
        "build_tracks, which a scene that tracks drive plays",
    )
    temporal: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="weight of the activations' change from frame to frame, beside 0.001 for "
        "their size, not a time as of fit_markers; of T that of the shapes' weights, beside 0.0001 "
        "for theirs; 0: none",
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
    reads=("rig", "performance", "activations", "tracks", "live_takes"),
    leaves="sequence",
    result="sequence.npz",
    hands_on=("sequence.npz",),
    options=FitSequence,
    frames=True,
)
