"""Estimate a neutral from photographs.

A face at rest for a person without a scan, from 1 to 8 photographs: the likeliest of the template's
people, with an expression in each photograph taken out. It stands in for the neutral scan that
build_model reads, and is an estimate, as is its size: every rig made of it says so.
"""

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import Box, JobOptions, Kind


class NeutralFromPhotos(JobOptions):
    """Options of an estimated neutral."""

    boxes: dict[str, Box] = Field(
        default={},
        max_length=8,
        description="left, top, right and bottom, px, of the face that is meant, by photograph, "
        "where it shows several and their landmarks are found",
    )
    w_l: float = Field(
        default=3.0,
        ge=0,
        le=1e6,
        description="price of each weight of an expression, linear: dear weights leave more of "
        "what photographs show to who it is",
    )
    w_w: float = Field(
        default=6.0,
        ge=0,
        le=1e6,
        description="price of the weights' squares: a prior of standard deviation 1 / sqrt(w_w)",
    )
    max_iterations: Whole = Field(
        default=30, ge=1, le=500, description="Gauss-Newton iterations of each stage at most"
    )


KIND = Kind(
    queue="short",
    reads=("template", "photos"),
    leaves="neutral",
    result="neutral.ply",
    options=NeutralFromPhotos,
)
