"""Fit markers.

Activations, jaw and head of every frame of a take of markers, with the spread of each; wrong points
are rejected, swaps mended, and muscles that no marker tells of held.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.document import FrameNumber, Whole
from solver.kinds.kind import JobOptions, Kind, LinearSolver


class FitMarkers(JobOptions):
    """Options of a fit of markers."""

    start: FrameNumber | None = Field(
        default=None, description="first frame to fit, as the file counts; null: its first"
    )
    end: FrameNumber | None = Field(
        default=None,
        description="the frame after the last to fit, as the file counts; null: all to the end",
    )
    step: Whole = Field(default=1, ge=1, description="fit every frame, every second ...")
    neutral: FrameNumber | None = Field(
        default=None,
        description="frame, as the file counts, at which the face is at rest, to bind without a "
        "marker set and to carry an actor's motion; null: a still second, most like the person",
    )
    actor: bool = Field(
        default=False,
        description="the take is another person's than the rig, whose motion is carried over",
    )
    rate: float | None = Field(
        default=None,
        ge=0.01,
        le=10_000,
        description="frames of the take per second; null: what the file says, else 60",
    )
    muscles: Literal["blended", "fibre"] = Field(
        default="blended",
        description="blended, six numbers a muscle with the rig's weights, within the limits that "
        "it was fitted in; fibre, one activation in [0, 1] a muscle or strip",
    )
    jaw: Literal["rig", "free", "tracks"] = Field(
        default="rig",
        description="rig, as that was fitted: tracks within limits, else free; free, five numbers; "
        "tracks, an angle and both condyles' slides along tracks",
    )
    prior: Literal["shapes", "scans", "none"] = Field(
        default="shapes",
        description="what makes a pose probable: shapes, the template's expressions; scans, the "
        "rig's own; none, the size of the activations alone",
    )
    temporal: float = Field(
        default=1.0,
        ge=0.001,
        le=1000,
        description="seconds in which a control that no marker tells of fades to the resting face",
    )
    hold_below: float = Field(
        default=0.2,
        ge=0,
        le=1,
        description="part of a muscle's spread that a frame must take away, or it counts as held",
    )
    sigma_mm: float = Field(
        default=0.2, ge=0.001, le=20, description="standard deviation of a seen point, mm"
    )
    robust_mm: float = Field(
        default=1.8,
        ge=0.001,
        le=50,
        description="distance at which a point has a quarter of its weight: two and a half times "
        "as far it is wrong",
    )
    smooth: bool = Field(
        default=False,
        description="sweep back over the take at the end, so that every frame knows of those after "
        "it too: smoother, and gaps are bridged from both sides",
    )
    refine: Whole = Field(
        default=20,
        ge=0,
        le=1000,
        description="frames, the nearest to the neutral face, by which the markers' places are "
        "mended first, left in markers.json for all takes of the session; 0: none, as with actor",
    )
    max_iterations: Whole = Field(
        default=15, ge=1, le=500, description="Gauss-Newton iterations per frame at most"
    )
    linear_solver: LinearSolver = None


KIND = Kind(
    queue="long",
    reads=(
        *("rig", "markers", "activations", "template", "fibre_muscles", "expression_basis"),
        "live_takes",
    ),
    leaves="sequence",
    result="sequence.npz",
    hands_on=("sequence.npz", "markers.json", "expression_basis.npz"),
    options=FitMarkers,
    frames=True,
)
