"""Calibrate fibre muscles.

Strengths, volume fractions and fibre directions of muscles with one activation in [0, 1] each, from
the scans that the rig was fitted to; its unseen expressions are a test.
"""

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import DoubleSolver, FitOptions, Kind


class FitFibres(FitOptions):
    """Options of a calibration of fibre muscles."""

    rounds: Whole = Field(
        default=16,
        ge=1,
        le=50,
        description="at most so many rounds of Gauss-Newton on strengths, fractions, directions "
        "and all poses",
    )
    strips_mm: float = Field(
        default=20.0,
        ge=0,
        le=200,
        allow_inf_nan=False,
        description="breadth, in mm, of strips that broad muscles are split into along their "
        "fibres, each with an activation of its own; 0: muscles stay whole",
    )
    linear_solver: DoubleSolver = None


KIND = Kind(
    queue="long",
    reads=("rig",),
    leaves="fibre_muscles",
    result="fibre_muscles.npz",
    folder="fibres",
    hands_on=("fibre_muscles.npz",),
    options=FitFibres,
)
