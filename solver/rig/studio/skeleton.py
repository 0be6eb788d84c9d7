"""Joints of a light rig, and how much of the skin goes with each.

    x = sum_j o_j T_j y

is linear blend skinning, as every program has it: T_j the motions of head, jaw and eyes off the
rest, y the shape before they move. The jaw's weight o is harmonic in the flesh, as tracks have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from solver.anatomy.embedding import LooseSkin
from solver.animation import Gaze, neck
from solver.mechanics.boundary import FreeJaw
from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import laplacian
from solver.model import SubjectModel
from solver.similarity import move_each, move_each_back
from solver.surface import Floats
from solver.tracks.shapes import skinning_of_skin, skinning_weights

HEAD = "head"
JAW = "jaw"
EYES = ("eye_left", "eye_right")


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints that hang on the first one, the head, and the skin's weights.

    The head's pivot is the neck's, the jaw's is half way between the condyles.
    """

    joints: tuple[str, ...]
    places: Floats  # (j, 3) of the joints at rest, mm
    weights: Floats  # (V, j), rows add up to 1

    @classmethod
    def of(cls, model: SubjectModel) -> Skeleton:
        """Return the joints of a person; eyes without an eyeball in the model have none."""
        balls = zip(EYES, Gaze(model).balls, strict=True)
        eyes = {name: ball for name, ball in balls if len(ball[0])}
        joints = (HEAD, JAW, *eyes)
        weights = np.zeros((len(model.skin.vertices), len(joints)))
        weights[:, 1] = _jaw_weights(model)
        for column, (vertices, _) in enumerate(eyes.values(), start=2):
            weights[vertices] = 0.0
            weights[vertices, column] = 1.0
        weights[:, 0] = 1.0 - weights[:, 1:].sum(axis=1)
        places = [neck(model), model.jaw.origin, *(centre for _, centre in eyes.values())]
        return cls(joints, np.array(places), weights)

    def motions(self, twists: Floats) -> Floats:
        """Return T (j, 4, 4) of joints that turn and move by ``twists`` (j, 6), in the head.

        A twist is a rotation vector about the joint's place, in rad, and a shift, in mm.
        """
        found = np.tile(np.eye(4), (len(self.joints), 1, 1))
        turns = Rotation.from_rotvec(twists[:, :3]).as_matrix()
        found[:, :3, :3] = turns
        found[:, :3, 3] = self.places - np.einsum("jab,jb->ja", turns, self.places) + twists[:, 3:]
        return found

    def twists(self, model: SubjectModel, jaw: Floats, eyes: Floats) -> Floats:
        """Return the twists (j, 6) of a free jaw's numbers (5,) and the eyes' turns (2, 3)."""
        found = np.zeros((len(self.joints), 6))
        motion = FreeJaw(model.jaw).matrix(jaw)
        place = self.places[1]
        found[1, :3] = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
        found[1, 3:] = motion[:3, :3] @ place + motion[:3, 3] - place
        for row, name in enumerate(self.joints):
            if name in EYES:
                found[row, :3] = eyes[EYES.index(name)]
        return found

    def skin(self, points: Floats, motions: Floats) -> Floats:
        """Return points (V, 3) moved by the joints' motions (j, 4, 4): linear blend skinning."""
        return move_each(np.tensordot(self.weights, motions, 1), points)

    def before(self, points: Floats, motions: Floats) -> Floats:
        """Return what :meth:`skin` takes to ``points`` (V, 3)."""
        return move_each_back(np.tensordot(self.weights, motions, 1), points)


def _jaw_weights(model: SubjectModel) -> Floats:
    """Return o (V,) on the whole skin: that of the flesh, and beyond it as loose skin follows."""
    gradients, volumes = shape_gradients(model.rest, model.tets)
    flesh = skinning_weights(model, laplacian(gradients, volumes, model.tets, len(model.rest)))
    found = np.zeros((len(model.skin.vertices), 1))
    found[model.embedded, 0] = skinning_of_skin(model, flesh)
    found[model.attached_mandible] = 1.0
    loose = LooseSkin(model)
    found[loose.ids] = loose.follow(found)
    return np.asarray(np.clip(found[:, 0], 0.0, 1.0))
