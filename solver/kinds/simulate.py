"""Simulate a scene of keys with a rig's flesh."""

from pydantic import Field

from solver.kinds.kind import JobOptions, Kind
from solver.kinds.options import LinearSolver, Video
from solver.kinds.scene import SimulateScene


class Simulate(JobOptions):
    """Options of a simulation."""

    scene: SimulateScene = Field(description="what is simulated, see docs/guide/simulation.md")
    video: Video = False
    linear_solver: LinearSolver = None


KIND = Kind(
    title="Simulate a scene",
    description="Plays keys of the rig's expressions, of muscles and of the jaw by its flesh, with "
    "contact, forces, objects and edits; frames can be read while the job runs.",
    queue="long",
    reads=("rig", "template", "assets"),
    leaves="animation",
    report="animation.json",
    result="animation.glb",
    folder="simulation",
    options=Simulate,
    frames=True,
)
