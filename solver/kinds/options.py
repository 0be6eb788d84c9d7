"""Options that several kinds of job share."""

from typing import Annotated, Literal

from pydantic import Field

from solver.kinds.kind import JobOptions

Axis = Literal["auto", "x", "-x", "y", "-y", "z", "-z"]
Distance = Annotated[
    Literal["point", "plane"],
    Field(
        description="what is made small: point, the distance to the scan's vertices; plane, its "
        "part along the scan's normals, so that the skin may slide along the scan"
    ),
]
LinearSolver = Annotated[
    Literal["rslab", "rslab-single", "cholmod", "superlu", None],
    Field(
        description="factorisation of the tangent stiffness; null: the fastest that is installed, "
        "in single precision"
    ),
]
DoubleSolver = Annotated[
    Literal["rslab", "cholmod", "superlu", None],
    Field(
        description="factorisation of the tangent stiffness; null: the fastest that is installed, "
        "in double precision"
    ),
]
Video = Annotated[bool, Field(description="write a film, animation.mp4, too")]


class FrameOptions(JobOptions):
    """Unit and axes of a raw scan."""

    unit: Literal["auto", "mm", "cm", "m", "inch"] = Field(
        default="auto",
        description="unit of the file's coordinates; auto: what the format says, else what makes "
        "it a head",
    )
    up: Axis = Field(
        default="auto",
        description="the file's axis that points to the top of the head; auto: found",
    )
    forward: Axis = Field(
        default="auto", description="the file's axis that points out of the face; auto: found"
    )
