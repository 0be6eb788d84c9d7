"""Our solver on the forward problem."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import Flesh, Material
from solver.surface import Floats

PHACE = Material(mu=1.0, lam=0.0, kappa=3.0, barrier=0.0)


class Ours:
    """Newton's method of :mod:`solver.mechanics.equilibrium`."""

    def __init__(self, problem: Mapping[str, np.ndarray]) -> None:
        self.start, self.a = problem["start"], problem["a"]
        self.flesh = Flesh(problem["rest"], problem["tets"], problem["held"], PHACE)

    def solve(self) -> tuple[Floats, int, str]:
        """Solve to the package's tolerance."""
        solver = linear.analyse(self.flesh.hessian(self.start, self.a))
        found = equilibrium.solve(self.flesh, solver, self.start, self.a)
        return found.x, found.iterations, "success"

    def energy(self, x: Floats) -> float:
        """Return E(x)."""
        return self.flesh.energy(x, self.a)

    def gradient(self, x: Floats) -> Floats:
        """Return dE/dx."""
        out = np.zeros_like(x)
        out[self.flesh.free] = self.flesh.gradient(x, self.a).reshape(-1, 3)
        return out


prepare = Ours
