"""Edit a face.

Fattens, slims, fills, operates on or paralyses the rig's person, and replays its expressions before
and after.
"""

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind
from solver.kinds.scene import EditScene


class Edit(JobOptions):
    """Options of an edit."""

    scene: EditScene = Field(description="what is edited, see docs/guide/simulation.md")


KIND = Kind(
    queue="long",
    reads=("rig", "template", "assets"),
    leaves="edit",
    result="edit.glb",
    folder="edited",
    options=Edit,
)
