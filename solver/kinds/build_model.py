"""Build a subject's model.

Flesh, bones and muscles inside the subject's neutral scan, from its template anatomy.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind


class BuildModel(JobOptions):
    """Options of a model."""

    edge_mm: float = Field(default=9.0, ge=3, le=30, description="edge length of the tetrahedra")
    muscles: Literal["compartments", "whole"] = Field(
        default="compartments",
        description="compartments: every muscle contracts in the parts that the template divides "
        "it into, each by itself; whole: as one",
    )


KIND = Kind(
    queue="short",
    reads=("neutral", "template"),
    leaves="model",
    result="model.npz",
    options=BuildModel,
)
