"""Fit activations and jaw of new expressions with a rig's muscle weights."""

from typing import Literal

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import ExpressionFitOptions, Kind, LinearSolver


class FitActivations(ExpressionFitOptions):
    """Options of a fit of activations."""

    max_iterations: Whole = Field(
        default=25,
        ge=1,
        le=500,
        description="Gauss-Newton iterations per expression at most; IPOPT may take four of its "
        "own for each",
    )
    solver: Literal["reduced", "ipopt"] = Field(
        default="reduced",
        description="reduced: positions are eliminated, and IPOPT steps in where that fails; "
        "ipopt: the full-space reference, minutes for an expression",
    )
    linear_solver: LinearSolver = None


KIND = Kind(
    title="Fit activations to new expressions",
    description="Activations and jaw of further expressions with the parent rig's muscle weights; "
    "the new rig carries the parent's expressions too.",
    queue="short",
    reads=("rig", "captures"),
    leaves="rig",
    report="report.json",
    result="rig.glb",
    folder="rig-new",
    options=FitActivations,
)
