"""Our solver on the forward problem."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import COROTATED_DET, Flesh
from solver.surface import Floats

PHACE = replace(COROTATED_DET, barrier_weight=0.0)
"""The peer's energy has no barrier against inversion; both minimise the same one."""


class Ours:
    """Newton's method of :mod:`solver.mechanics.equilibrium`."""

    def __init__(self, problem: Mapping[str, np.ndarray]) -> None:
        self.start = problem["start"]
        self.a = problem["a"]
        self.flesh = Flesh(problem["rest"], problem["tets"], problem["held"], PHACE)

    def solve(self) -> tuple[Floats, int, str]:
        """Solve to the package's tolerance."""
        solver = linear.analyse(self.flesh.hessian(self.start, self.a))
        found = equilibrium.solve_equilibrium(self.flesh, solver, self.start, self.a)
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
