"""``liblaf-apple`` on the forward problem, by its documented way: ``Forward(model).step()``.

Its activation is A - I in the order (xx, yy, zz, xy, xz, yz), its volume term 3 (det F - 1)^2.
"""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
import pyvista as pv
import warp as wp
from liblaf.apple import constants
from liblaf.apple.model import Forward, Model, ModelBuilder
from liblaf.apple.warp import Phace

wp.config.quiet = True
wp.init()


class Apple:
    """Its preconditioned nonlinear conjugate gradients, all options at their defaults."""

    def __init__(self, problem: Mapping[str, np.ndarray]) -> None:
        self.rest = problem["rest"]
        moved = problem["start"] - self.rest
        held = np.isin(np.arange(len(self.rest)), problem["held"])
        tets = problem["tets"]
        cells = np.insert(tets, 0, 4, axis=1).ravel()
        mesh = pv.UnstructuredGrid(cells, np.full(len(tets), pv.CellType.TETRA), self.rest)
        builder = ModelBuilder()
        builder.assign_global_ids(mesh)
        mesh.point_data[constants.DIRICHLET_MASK] = held
        mesh.point_data[constants.DIRICHLET_VALUE] = np.where(held[:, None], moved, 0.0)
        a = problem["a"][:, [0, 3, 5, 1, 2, 4]]
        mesh.cell_data[constants.ACTIVATION] = a - [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
        for name, value in {"MUSCLE_FRACTION": 1.0, "MU": 1.0, "LAMBDA": 3.0}.items():
            mesh.cell_data[getattr(constants, name)] = np.full(len(tets), value)
        builder.add_dirichlet(mesh)
        builder.add_energy(Phace.from_pyvista(mesh))
        self.model: Model = builder.finalize()
        self.model.u_free = self.model.to_free(jnp.asarray(moved))

    def solve(self) -> tuple[np.ndarray, int, str]:
        """Solve by the package's own criteria."""
        found = Forward(self.model).step()
        x = self.rest + np.asarray(self.model.u_full)
        return x, int(found.stats.n_steps), str(found.result)

    def energy(self, x: np.ndarray) -> float:
        """Return its E(x)."""
        return float(self.model.fun(jnp.asarray(x - self.rest)))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Return its dE/dx."""
        u = jnp.asarray(x - self.rest)
        free = self.model.to_free(self.model.grad(u))
        return np.asarray(self.model.dirichlet.to_full(free, 0.0))


prepare = Apple
