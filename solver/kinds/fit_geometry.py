"""Fit the muscle geometry.

Muscle weights S, activations and jaw of several expressions at once; the result is a rig.
"""

from typing import Annotated

from pydantic import Field

from solver.kinds.document import Integral
from solver.kinds.kind import DoubleSolver, ExpressionFitOptions, Kind


class FitGeometry(ExpressionFitOptions):
    """Options of a fit of S, activations and jaw."""

    rounds: Annotated[int, Field(ge=1, le=50), Integral] | None = Field(
        default=None,
        description="at most so many rounds of Gauss-Newton on S and all poses: by default 4 where "
        "the template is trained, else 12; admissible controls take up to 1.7 times as many more, "
        "with a trained template up to three times, to close their bounds",
    )
    symmetry: float = Field(
        default=0.0,
        ge=0,
        allow_inf_nan=False,
        description="weight of the mirror prior on the changes of S, which makes left and right "
        "alike; 0: none, 1e-3: much",
    )
    smoothness: float = Field(
        default=0.0,
        ge=0,
        allow_inf_nan=False,
        description="weight of the prior that keeps the changes of S alike where compartments of "
        "one muscle meet; 0: none",
    )
    linear_solver: DoubleSolver = None


KIND = Kind(
    queue="long",
    reads=("model", "captures", "activations"),
    asks=("start",),
    leaves="rig",
    report="report.json",
    result="rig.glb",
    options=FitGeometry,
)
