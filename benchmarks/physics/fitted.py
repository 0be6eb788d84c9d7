"""A person whose fits are done: what simulations begin with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp

from solver.animation.blendshapes import Blendshapes
from solver.fitting.face import Face, Pose
from solver.fitting.interior_point import FeasibleSet
from solver.kinds.scene import STIFFNESS_PA
from solver.mechanics.flesh import COROTATED_TRACE
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.rig import Rig
from solver.similarity import IDENTITY, Similarity
from solver.simulation.forces import Drive


@dataclass(frozen=True)
class Fitted:
    """A subject model with its muscle geometry and named poses, of a rig or of blendshapes."""

    model: SubjectModel
    S: sp.csr_array
    poses: dict[str, Pose]
    shapes: Blendshapes
    rig: Rig

    @classmethod
    def load(cls, rig: Path, shapes: Path) -> Fitted:
        """Read the files of jobs: a rig, or its folder, and blendshapes."""
        found = Rig.load(rig)
        return cls(
            found.model,
            found.weights,
            {fit.name: Pose(fit.activations, fit.jaw) for fit in found.expressions},
            Blendshapes.load(shapes, found.model, found.weights),
            found,
        )

    @property
    def limits(self) -> FeasibleSet | None:
        """What the muscles of the rig can do."""
        return self.rig.limits

    def rig_face(self) -> Face:
        """Return the face as the rig was fitted."""
        return self.rig.face(fastest())

    def face(self, *, pinned: bool = False) -> Face:
        """Return the face in the material of its fits, in Pa."""
        return Face(
            self.model, self.S, material=COROTATED_TRACE.in_pascal(STIFFNESS_PA), pinned=pinned
        )

    def blend(self, *beginnings: str) -> Pose:
        """Return the pose of all blendshapes whose names begin so."""
        names = self.shapes.blend.names
        return self.shapes.blend.pose(np.array([float(n.startswith(beginnings)) for n in names]))

    def drive(self, face: Face, pose: Pose, time: float, head: Similarity = IDENTITY) -> Drive:
        """Return what asks for a pose."""
        return Drive(time, face.flesh_controls(pose.a), pose.b, head)
