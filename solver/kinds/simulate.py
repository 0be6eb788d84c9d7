"""Simulate a scene.

Plays fitted performances and keys of the rig's expressions, of muscles and of the jaw by its flesh,
with contact, forces, objects and edits; frames can be read while the job runs.
"""

from pydantic import Field

from solver.kinds.kind import Kind, PlayOptions
from solver.kinds.scene import SimulateScene


class Simulate(PlayOptions):
    """Options of a simulation."""

    scene: SimulateScene = Field(description="what is simulated, see docs/guide/simulation.md")


KIND = Kind(
    queue="long",
    reads=("rig", "template", "assets", "sequences", "fibre_muscles", "tracks"),
    leaves="animation",
    result="animation.glb",
    folder="simulation",
    options=Simulate,
    frames=True,
)
