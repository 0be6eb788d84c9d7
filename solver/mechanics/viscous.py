"""Flesh that is slow to leave where it is: an implicit Euler step of an overdamped motion.

    E(x, a) + tau/2 |x - x_0|^2_K

with K the stiffness at rest and x_0 the place before the step. Near buckling, where the flesh by
itself would snap, such a step stays short; without motion it feels nothing (a proximal point
method, Rockafellar 1976; the time step is 1 / tau).
"""

from __future__ import annotations

import scipy.sparse as sp

from solver.mechanics.flesh import Flesh
from solver.surface import Floats


class Viscous(Flesh):
    """The same flesh with the ``viscosity`` tau, a part of its stiffness, and ``anchor`` x_0."""

    def __init__(self, flesh: Flesh) -> None:
        # it is the same flesh, with all that was computed for it
        vars(self).update(vars(flesh))
        self.viscosity = 0.0
        self.anchor = flesh.rest
        self._stiffness = flesh.hessian(flesh.rest, flesh.passive())

    def energy(self, x: Floats, a: Floats) -> float:
        """See :meth:`Flesh.energy`."""
        moved = self._moved(x)
        return super().energy(x, a) + 0.5 * self.viscosity * float(
            moved @ (self._stiffness @ moved)
        )

    def gradient(self, x: Floats, a: Floats) -> Floats:
        """See :meth:`Flesh.gradient`."""
        drag: Floats = self.viscosity * (self._stiffness @ self._moved(x))
        return super().gradient(x, a) + drag

    def hessian(self, x: Floats, a: Floats, *, project: float = 0.0) -> sp.csr_array:
        """See :meth:`Flesh.hessian`."""
        matrix = super().hessian(x, a, project=project)
        matrix.data += self.viscosity * self._stiffness.data
        return matrix

    def _moved(self, x: Floats) -> Floats:
        moved: Floats = (x - self.anchor)[self.free].ravel()
        return moved
