"""(A) in full space: minimise f over (x, a, b) subject to equilibrium."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser
from solver.fitting.reference.common import Listener, Reference
from solver.fitting.reference.expression import Expression
from solver.fitting.reference.one import minimise
from solver.fitting.terms import Term
from solver.surface import Floats


def activations(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    start: Pose,
    x: Floats,
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 1000,
    listen: Listener | None = None,
) -> Reference:
    """Minimise f over (x, a, b) subject to equilibrium, by IPOPT, from ``start`` and ``x`` (p, 3).

    Raises :class:`NotConvergedError` (``ipopt.failed``) with IPOPT's message.
    """
    expression = Expression(face, S, data, MusclePriors(regulariser))
    return minimise(expression, S, start, x, tolerance, max_iterations, listen)


@dataclass(frozen=True)
class MusclePriors:
    """A regulariser as :class:`~solver.fitting.reference.expression.Priors`."""

    regulariser: Regulariser

    def value(self, pose: Pose) -> float:
        """See :class:`Priors`."""
        return self.regulariser.value(pose)

    def gradient(self, pose: Pose) -> Floats:
        """See :class:`Priors`."""
        return self.regulariser.gradient(pose)

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """See :class:`Priors`."""
        whole = self.regulariser.gauss_newton(pose)
        entries = np.arange(pose.a.size).reshape(-1, 6)
        return whole[entries[:, :, None], entries[:, None, :]], np.diag(whole)[-5:]
