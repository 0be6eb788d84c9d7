"""Build a studio's rig.

Solves the person's own ARKit shapes in flesh that meets teeth and eyeballs, and leaves a light rig
with these morph targets and joints for head, jaw and eyes, with how far it is from the flesh.
"""

from typing import Literal

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind


class BuildStudioRig(JobOptions):
    """Options of a studio's rig."""

    driven_by: Literal["shapes", "joints"] = Field(
        default="shapes",
        description="what opens the jaw and turns the eyes: the shapes, as ARKit's do, or joints, "
        "by the turns that studio.json has for each shape's weight; shapes then leave these out",
    )


KIND = Kind(
    queue="long",
    reads=("rig", "template", "blendshapes", "expression_basis", "texture", "normals", "wrinkles"),
    leaves="studio",
    result="studio.glb",
    hands_on=("blendshapes.npz", "expression_basis.npz"),
    options=BuildStudioRig,
)
