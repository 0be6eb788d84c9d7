"""Play a recording of Live Link Face by a rig's flesh."""

from pydantic import Field

from solver.kinds.kind import Kind, PlayOptions
from solver.kinds.scene import AnimateScene


class Animate(PlayOptions):
    """Options of an animation."""

    scene: AnimateScene = Field(description="what is animated, see docs/guide/simulation.md")


KIND = Kind(
    title="Animate by a recording",
    description="Plays a recording of Live Link Face by the rig's flesh, with contact, forces, "
    "objects and edits; frames can be read while the job runs.",
    queue="long",
    reads=("rig", "template", "assets", "blendshapes", "expression_basis"),
    leaves="animation",
    result="animation.glb",
    hands_on={"blendshapes.npz": "blendshapes", "expression_basis.npz": "expression_basis"},
    options=Animate,
    frames=True,
)
