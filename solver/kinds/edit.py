"""Edit a person's anatomy, and replay the rig's expressions before and after."""

from pydantic import Field

from solver.kinds.kind import Kind, Options
from solver.kinds.scene import EditScene


class Edit(Options):
    """Options of an edit."""

    scene: EditScene = Field(description="what is edited, see docs/guide/simulation.md")


KIND = Kind(
    title="Edit a face",
    description="Fattens, slims, fills, operates on or paralyses the rig's person, and replays its "
    "expressions before and after.",
    queue="long",
    reads=("rig", "template", "assets"),
    leaves="edit",
    report="edit.json",
    result="edit.glb",
    folder="edited",
    options=Edit,
)
