"""The neutral face, which every fit of an expression can begin with."""

from __future__ import annotations

from functools import cached_property

import scipy.sparse as sp

from solver.fitting import gauss_newton
from solver.fitting.face import Face, State
from solver.fitting.objective import Target
from solver.fitting.terms import SkinDistance
from solver.surface import Floats


class Resting:
    """What all expressions of a face with S share: ``state``, the neutral face as an equilibrium.

    Raises :class:`SolveError` if there is none.
    """

    def __init__(self, face: Face, S: sp.csr_array) -> None:
        self._face = face
        self._S = S
        self.state: State = face.rest_state(S)

    @cached_property
    def matrix(self) -> Floats:
        """Return the Gauss-Newton matrix (:func:`gauss_newton.curvature`) for points all alike.

        It is computed when first asked for.
        """
        target = Target.from_points(self._face.face_points(self.state.x))
        data = SkinDistance(self._face, target)
        return gauss_newton.curvature(self._face, self._S, data, self.state)
