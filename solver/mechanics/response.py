"""The equilibrium's answer to what drives it: dx/dq as columns, products and adjoint products.

grad_x E(x; q) = 0 makes the free vertices an implicit function of controls q (k,): activations, the
jaw, a muscle's weights, objects. With H the exact Hessian and G = d(grad E)/dq, both by the free
coordinates,

    dx_free/dq = -H^-1 G,    (dx/dq)^T g = -G^T H^-1 g_free + (dx_held/dq)^T g_held,

where the held vertices move as q says. One factorisation serves them all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.mechanics.boundary import BoundaryRates, Potential, curvature
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import Factor, GrowingSolver, LinearSolver, NotPositiveDefiniteError
from solver.surface import Floats


class FleshControls(Protocol):
    """Controls q (k,) of a flesh at one state x: the linear map G and the held vertices' motion."""

    held: sp.csr_array  # dx_held/dq as (3 p, k): zero rows for free coordinates

    def columns(self) -> Floats:
        """Return G (size, k) in memory order of columns; the caller may overwrite it."""

    def product(self, change: Floats) -> Floats:
        """Return G dq (size,) for dq (k,)."""

    def adjoint(self, motion: Floats) -> Floats:
        """Return G^T y (k,) for y (size,)."""


@dataclass(frozen=True)
class SparseControls(FleshControls):
    """Controls with G as a matrix: ``forces`` (size, k), ``held`` (3 p, k).

    The forces are dense where held vertices move, as their coupling is.
    """

    forces: sp.csc_array | Floats
    held: sp.csr_array

    @classmethod
    def of(
        cls,
        flesh: Flesh,
        x: Floats,
        a: Floats,
        rates: sp.csr_array | Floats,
        boundary: BoundaryRates | None = None,
        potentials: Sequence[Potential] = (),
    ) -> SparseControls:
        """Differentiate the forces on a flesh at x (p, 3) with its controls ``a``.

        ``rates`` (controls, k) is da/dq, of activations each tet's six entries in turn;
        ``boundary`` is how held vertices, jaw and objects move, if they do; ``potentials`` are
        placed where x is.
        """
        count = rates.shape[1]
        forces = flesh.forces_by_control(x, a) @ rates
        if boundary is not None:
            contact = curvature(potentials, x)
            pull, held = boundary_forces(flesh, x, a, boundary, potentials, contact)
            return cls(np.asarray(forces + pull), held)
        return cls(sp.csc_array(forces), sp.csr_array((flesh.rest.size, count)))

    @override
    def columns(self) -> Floats:
        if isinstance(self.forces, np.ndarray):
            return np.array(self.forces, order="F")
        return np.asarray(self.forces.toarray(order="F"))

    @override
    def product(self, change: Floats) -> Floats:
        return np.asarray(self.forces @ change)

    @override
    def adjoint(self, motion: Floats) -> Floats:
        return np.asarray(self.forces.T @ motion)


@dataclass(frozen=True)
class ChainedControls(FleshControls):
    """Controls q (k,) that drive the flesh by way of r other numbers y: G = (dG/dy) (dy/dq).

    ``forces`` (size, r) is sparse as few numbers drive a vertex, ``rates`` (r, k) dense.
    """

    forces: sp.csr_array
    rates: Floats
    held: sp.csr_array

    @override
    def columns(self) -> Floats:
        return np.asfortranarray(self.forces @ self.rates)

    @override
    def product(self, change: Floats) -> Floats:
        return np.asarray(self.forces @ (self.rates @ change))

    @override
    def adjoint(self, motion: Floats) -> Floats:
        return np.asarray(self.rates.T @ (self.forces.T @ motion))


def boundary_forces(
    flesh: Flesh,
    x: Floats,
    a: Floats,
    boundary: BoundaryRates,
    potentials: Sequence[Potential],
    contact: sp.csr_array,
) -> tuple[Floats, sp.csr_array]:
    """Return the free gradient's change (size, k) as the ``boundary`` moves, and dx_held/dq.

    The flesh is at x (p, 3) with controls ``a``, the ``potentials`` are placed where it is, and
    ``contact`` is their :func:`~solver.mechanics.boundary.curvature` there.
    """
    motion = np.zeros((*flesh.rest.shape, boundary.count))
    motion[flesh.held] = boundary.held
    flat = motion.reshape(flesh.rest.size, -1)
    by_contact = contact @ flat
    for each in potentials:
        by_contact += each.by_boundary(x, boundary).reshape(by_contact.shape)
    pull = flesh.coupling(x, a, motion) + by_contact[flesh.free_coordinates]
    return np.asarray(pull), sp.csr_array(flat)


class Response:
    """dx/dq at one equilibrium of ``flesh``, by a ``factor`` of the Hessian there.

    ``minimum`` is False where that Hessian is indefinite: near a fold the answer leads off it.
    """

    def __init__(self, flesh: Flesh, factor: Factor, *, minimum: bool = True) -> None:
        self.minimum = minimum
        self._flesh = flesh
        self._factor = factor

    @classmethod
    def exact(
        cls,
        flesh: Flesh,
        x: Floats,
        a: Floats,
        *,
        contact: sp.csr_array | None = None,
        linear: LinearSolver | GrowingSolver | None = None,
    ) -> Response:
        """Factorise the Hessian at x (p, 3) with ``a`` (n, 6), nothing of it projected.

        ``contact`` (3 p, 3 p) is the :func:`~solver.mechanics.boundary.curvature` of what touches.
        ``linear`` solves for the flesh's pattern; with contact the pattern is analysed anew unless
        it is one that grows.
        Raises :class:`~solver.mechanics.linear.NotPositiveDefiniteError` where it is singular.
        """
        matrix = flesh.hessian(x, a)
        if contact is None:
            contact = sp.csr_array((x.size, x.size))
        if linear is None or (contact.nnz and not isinstance(linear, GrowingSolver)):
            linear = GrowingSolver(matrix)
        if isinstance(linear, GrowingSolver):
            linear = linear.plus(flesh.free_block(contact))
        try:
            return cls(flesh, linear.factor(matrix.data))
        except NotPositiveDefiniteError:
            return cls(flesh, linear.factor(matrix.data, indefinite=True), minimum=False)

    def columns(self, controls: FleshControls) -> Floats:
        """Return dx_free/dq (size, k)."""
        found = self._factor.solve(controls.columns())
        # in place: on fine meshes new memory takes as long as arithmetic
        return np.negative(found, out=found)

    def motions(self, controls: FleshControls) -> Floats:
        """Return dx/dq of all vertices, (p, 3, k)."""
        out = controls.held.toarray()
        out[self._flesh.free_coordinates] = self.columns(controls)
        return np.asarray(out.reshape(len(self._flesh.rest), 3, -1))

    def product(self, controls: FleshControls, change: Floats) -> Floats:
        """Return dx/dq dq: the motion (p, 3) of all vertices for a change (k,) of the controls."""
        out = np.asarray(controls.held @ change)
        out[self._flesh.free_coordinates] = self.free_motion(controls, change)
        return out.reshape(-1, 3)

    def free_motion(self, controls: FleshControls, change: Floats) -> Floats:
        """Return dx_free/dq dq (size,) for a change (k,) of the controls."""
        return -self._factor.solve(controls.product(change))

    def free_adjoint(self, controls: FleshControls, gradient: Floats) -> Floats:
        """Return (dx_free/dq)^T g (k,) for g by the free coordinates (size,)."""
        return controls.adjoint(-self._factor.solve(gradient))

    def adjoint(self, controls: FleshControls, gradient: Floats) -> Floats:
        """Return (dx/dq)^T g (k,) for g by the vertices (p, 3), by one solve."""
        flat = gradient.ravel()
        free = self.free_adjoint(controls, flat[self._flesh.free_coordinates])
        return np.asarray(free + controls.held.T @ flat)
