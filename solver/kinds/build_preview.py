"""Make a rig's sliders.

The page's sliders move a reduced skin: poses of the rig's muscles and jaw are simulated, the skin
is fitted to them, and its error measured on others. The rig's files have its preview.bin once it is
done.
"""

from pydantic import Field

from solver.kinds.document import Whole
from solver.kinds.kind import JobOptions, Kind


class BuildPreview(JobOptions):
    """Options of a rig's sliders."""

    seed: Whole = Field(
        default=0,
        ge=0,
        le=2**32 - 1,
        description="of the poses: the same seed gives the same sliders",
    )
    max_seconds: float = Field(
        default=600.0,
        ge=10,
        le=7200,
        description="after about so long it is made of the poses that are ready",
    )


KIND = Kind(
    queue="short", reads=("rig",), leaves="preview", result="preview.bin", options=BuildPreview
)
