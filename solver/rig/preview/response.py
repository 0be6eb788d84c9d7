"""How the skin answers to the sliders at a sample: a whole derivative for one factorisation."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.fitting.sensitivity import coordinates, gradient_by_pose
from solver.mechanics import jaw
from solver.rig.preview.controls import Controls
from solver.rig.preview.samples import Sample, state_at
from solver.surface import Floats


class Responses:
    """Derivatives by the sliders of the skin's inner products with ``modes`` (r, n, 3)."""

    def __init__(self, face: Face, S: sp.csr_array, controls: Controls, modes: Floats) -> None:
        self._face, self._S, self._controls = face, S, controls
        model = face.model
        count = len(modes)
        moved = modes[:, model.embedded].transpose(1, 0, 2).reshape(len(model.embedded), -1)
        by_vertex = (model.embedding.T @ moved).reshape(-1, count, 3)
        self._of_x = np.ascontiguousarray(by_vertex.transpose(1, 0, 2).reshape(count, -1))
        self._of_mandible = modes[:, model.attached_mandible].reshape(count, -1)

    def at(self, sample: Sample) -> Floats | None:
        """Return the derivatives (r, k) at a sample; None where the flesh is about to buckle."""
        face, controls, model = self._face, self._controls, self._face.model
        state = state_at(face, self._S, controls, sample.slid.values, sample.x)
        if not state.equilibrium.minimum:
            return None
        forces = gradient_by_pose(face, self._S, state.pose, state.x) @ controls.directions
        by_jaw, b = controls.directions[-5:], state.pose.b
        out = self._of_x[:, coordinates(face.flesh.free)] @ -state.equilibrium.factor.solve(forces)
        mandible = face.mandible_jacobian(b)[model.mandible].reshape(-1, jaw.DEGREES_OF_FREEDOM)
        out += self._of_x[:, coordinates(model.mandible)] @ (mandible @ by_jaw)
        points = model.skin.vertices[model.attached_mandible]
        attached = jaw.jacobian(model.jaw, points, b).reshape(-1, jaw.DEGREES_OF_FREEDOM)
        return np.asarray(out + self._of_mandible @ (attached @ by_jaw))
