"""Animate by a recording.

Plays a recording of Live Link Face or OpenFace, or a video, by the rig's flesh, with contact,
forces, objects and edits; frames can be read while the job runs.
"""

from pydantic import Field

from solver.kinds.kind import Kind, PlayOptions
from solver.kinds.scene import AnimateScene


class Animate(PlayOptions):
    """Options of an animation."""

    scene: AnimateScene = Field(description="what is animated, see docs/guide/simulation.md")


KIND = Kind(
    queue="long",
    reads=(
        *("rig", "template", "assets", "blendshapes", "expression_basis", "controls", "tracks"),
        *("live_takes", "signals"),
    ),
    leaves="animation",
    result="animation.glb",
    hands_on=("blendshapes.npz", "expression_basis.npz", "signals.csv"),
    options=Animate,
    frames=True,
)
