"""(P) in full space: minimise the per-tet model's f over (x, activations, b), for small meshes.

Every active tet is a muscle by itself (:mod:`solver.fitting.per_tet.tissue`), so the problem is (A)
with the priors of :mod:`solver.fitting.per_tet`; the contractions gamma_m are the best at every
iterate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting.face import Face, Pose
from solver.fitting.objective import JAW_UNITS
from solver.fitting.per_tet import Objective, PerTetOptions, rest_state
from solver.fitting.per_tet import tissue as tissues
from solver.fitting.reference.common import Listener, Reference
from solver.fitting.reference.expression import Expression
from solver.fitting.reference.one import minimise
from solver.fitting.terms import Term
from solver.surface import Floats


def per_tet(
    face: Face,
    data: Term,
    options: PerTetOptions | None = None,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
    listen: Listener | None = None,
) -> Reference:
    """Minimise (P) by IPOPT from the resting face; the pose's ``a`` are those of the active tets.

    Raises :class:`InputError` (``model.no_fibres``, ``model.no_muscle``) and
    :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    options = options or PerTetOptions()
    tissue = tissues.of_face(face)
    rest = rest_state(tissue)
    priors = TetPriors(Objective(tissue, data, options, rest.pose.b), options.w_b)
    expression = Expression(tissue.face, tissue.selection, data, priors)
    return minimise(
        expression, tissue.selection, rest.pose, rest.x, tolerance, max_iterations, listen
    )


@dataclass(frozen=True)
class TetPriors:
    """The per-tet regularisers as :class:`~solver.fitting.reference.expression.Priors`."""

    objective: Objective
    w_b: float

    def value(self, pose: Pose) -> float:
        """See :class:`Priors`."""
        return self.objective.prior_value(pose)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`Priors`."""
        by_a, by_b = self.objective.prior_gradient(pose)
        return np.concatenate([by_a.ravel(), by_b])

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """See :class:`Priors`."""
        return self.objective.prior_blocks(pose.a), self.w_b * JAW_UNITS**2
