"""Fit activations to new expressions.

Activations and jaw of further expressions with the parent rig's muscle weights; the new rig carries
the parent's expressions too.
"""

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
    linear_solver: LinearSolver = None


KIND = Kind(
    queue="short",
    reads=("rig", "captures", "activations"),
    leaves="rig",
    report="report.json",
    result="rig.glb",
    folder="rig-new",
    options=FitActivations,
)
