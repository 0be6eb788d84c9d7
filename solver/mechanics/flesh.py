"""The flesh as a whole: energy, gradient and Hessian over the mesh.

Vertices are held (bones, cuts) or free; gradients and Hessians are taken by the free ones, in the
order of their vertex numbers, three coordinates each. Stress is in units of mu, lengths in mm.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.mechanics import elements, laws
from solver.mechanics.assembly import BlockSum, VertexSum, couple
from solver.mechanics.elements import Elements
from solver.mechanics.laws import Law
from solver.mechanics.terms import ElasticTerm, EnergyTerm, SlidingPlanes, no_planes
from solver.surface import Floats, Ints

# the activation a_I of passive flesh: S(a_I) = I
IDENTITY = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


@dataclass(frozen=True)
class Material:
    """Parameters, in stress units, of a ``law``: a module of :mod:`solver.mechanics.materials`.

    At small strains all have Lame's constants ``mu`` and ``lam + 2 kappa``. The defaults are the
    flesh of the muscle geometry paper: the trace of the stretch resists change of volume.
    """

    mu: float = 1.0
    lam: float = 1.0
    kappa: float = 0.0
    # of the barrier that keeps det F above 0.09 in a scream; with 5 tets were flattened to 0.02
    barrier_weight: float = 20.0
    law: Law = "corotated"

    def in_pascal(self, pascals: float) -> Material:
        """Return the material in Pa, where a stress of 1 is ``pascals``."""
        stresses = ("mu", "lam", "kappa", "barrier_weight")
        return replace(self, **{name: pascals * getattr(self, name) for name in stresses})


COROTATED_TRACE = Material()  # the flesh of the muscle geometry paper

# The flesh of Phace as published, mu |F - R S(a)|^2 + 3 mu (det F - det S(a))^2, whose own term
# resists flattening: the barrier is weaker.
COROTATED_DET = Material(mu=1.0, lam=0.0, kappa=3.0, barrier_weight=5.0)

# The stable Neo-Hookean flesh that is like Phace's at small strains.
NEO_HOOKEAN = replace(COROTATED_DET, law="neo_hookean")

# Nearly incompressible flesh for fibre muscles: a bulk modulus of 6.7 mu, as linear tets lock above
# ten.
MOONEY_RIVLIN = replace(COROTATED_DET, law="mooney_rivlin")

# as documents name them
LAWS: Mapping[str, Material] = {
    "corotated_trace": COROTATED_TRACE,
    "corotated_det": COROTATED_DET,
    "neo_hookean": NEO_HOOKEAN,
    "mooney_rivlin": MOONEY_RIVLIN,
}


def shape_gradients(rest: Floats, tets: Ints) -> tuple[Floats, Floats]:
    """Return the linear shape functions' gradients (n, 4, 3) in 1/mm and rest volumes (n,) in mm^3.

    Raises :class:`InputError` (``mesh.inverted``) naming the first tet without positive volume.
    """
    corners = rest[tets]
    edges = corners[:, 1:] - corners[:, :1]
    volumes = np.linalg.det(edges) / 6.0
    bad = np.flatnonzero(~(volumes > 0.0))
    if len(bad):
        message = (
            f"{len(bad)} tetrahedra have no positive rest volume, the first is number {bad[0]}"
        )
        raise InputError("mesh.inverted", message, tet=int(bad[0]))
    inverse = np.linalg.inv(edges)
    gradients = np.empty((len(tets), 4, 3))
    gradients[:, 1:] = inverse.transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    return gradients, volumes


class _Summed:
    """A term with what sums its entries up to a flesh's gradient and Hessian."""

    def __init__(self, term: EnergyTerm, flesh: Flesh) -> None:
        self.term = term
        self._flesh = flesh
        self._numbers = flesh.free_numbers[term.vertices]

    @cached_property
    def vertex_sum(self) -> VertexSum:
        return VertexSum(self._numbers, len(self._flesh.free))

    @cached_property
    def block_sum(self) -> BlockSum:
        return BlockSum(self._numbers, len(self._flesh.free), self._flesh.block_sum)


class Drag:
    """Flesh that is slow to leave where it is: an implicit Euler step of an overdamped motion.

        E(x) = tau/2 |x - x_0|^2_K

    with K the stiffness of the flesh at rest by its free coordinates, ``viscosity`` tau and
    ``anchor`` x_0 (p, 3), the place before the step, which both may be changed at any time. Near
    buckling, where the flesh by itself would snap, such a step stays short (a proximal point
    method, Rockafellar 1976; the time step is 1 / tau).
    """

    def __init__(self, flesh: Flesh) -> None:
        self._K = flesh.hessian(flesh.rest, flesh.passive())
        self._free = flesh.free
        self.viscosity = 0.0
        self.anchor = flesh.rest

    def energy(self, x: Floats) -> float:
        """Return E(x)."""
        return 0.5 * float(self._motion(x) @ self.gradient(x))

    def gradient(self, x: Floats) -> Floats:
        """Return dE/dx by the free coordinates, (size,)."""
        return np.asarray(self.viscosity * (self._K @ self._motion(x)))

    def hessian_values(self) -> Floats:
        """Return the values of d2E/dx2 in the pattern of the flesh's Hessian."""
        return np.asarray(self.viscosity * self._K.data)

    def _motion(self, x: Floats) -> Floats:
        return np.asarray((x - self.anchor)[self._free].ravel())


class Flesh:
    """Elastic, active tetrahedra with some vertices held.

    ``rest`` (p, 3) are vertices in mm, ``tets`` (n, 4) their numbers, with positive rest volumes.
    The ``held`` ones do not move freely, some of the others stay on ``sliding`` planes. A tet may
    have ``shares`` (n,), the part of its volume that it stands for (a tet of two tissues is listed
    twice), a ``stiffness_factor`` (n,) of its material, and ``growth`` (n,), the f of plastic
    growth F_p = f I: its energy is V psi(F F_p^-1, A) with its rest volume V as it was (muscle
    geometry paper, fat).

    ``free`` lists the free vertices, ``free_numbers`` (p,) has each vertex's place in that list or
    -1, ``held`` lists the others.
    """

    def __init__(
        self,
        rest: Floats,
        tets: Ints,
        held: Ints,
        material: Material | None = None,
        shares: Floats | None = None,
        sliding: SlidingPlanes | None = None,
        stiffness_factor: Floats | None = None,
        growth: Floats | None = None,
    ) -> None:
        self.material = material or Material()
        self.rest = np.ascontiguousarray(rest, dtype=np.float64)
        self.tets = np.ascontiguousarray(tets, dtype=np.int64)
        self.gradients, self.volumes = shape_gradients(self.rest, self.tets)
        if shares is not None:
            self.volumes = self.volumes * shares
        if growth is not None:
            # F F_p^-1 is linear in the vertices as F is
            self.gradients /= growth[:, None, None]
        given = self.material
        law = self.material.law
        factor = np.ones(len(self.tets)) if stiffness_factor is None else stiffness_factor
        mu, lam = laws.own_moduli(law, given.mu * factor, given.lam * factor)
        kappa = given.kappa * factor
        barrier = given.barrier_weight * factor
        mesh = self.tets, self.gradients, self.volumes
        self.elements = Elements(*mesh, mu, lam, kappa, barrier, laws.number(law))
        is_free = np.ones(len(self.rest), dtype=bool)
        is_free[held] = False
        self.free = np.flatnonzero(is_free)
        self.held = np.flatnonzero(~is_free)
        self.free_numbers = np.full(len(self.rest), -1)
        self.free_numbers[self.free] = np.arange(len(self.free))
        self.sliding = sliding or no_planes()
        self.elastic = ElasticTerm(self.elements)
        self._passive = np.tile(IDENTITY, (len(self.tets), 1))
        self._first: EnergyTerm = self.elastic
        self._others: tuple[_Summed, ...] = ()
        self._drag: Drag | None = None
        if len(self.sliding.vertices):
            self._others = (_Summed(self.sliding, self),)

    def plus(self, *terms: EnergyTerm) -> Flesh:
        """Return this flesh with more terms in its energy, of its tets or of its free vertices."""
        other = copy.copy(self)
        other._others = (*self._others, *(_Summed(term, self) for term in terms))
        return other

    @property
    def terms(self) -> tuple[EnergyTerm, ...]:
        """Return the terms of the energy, the tets' law first."""
        return self._first, *(each.term for each in self._others)

    def slowed_by(self, drag: Drag) -> Flesh:
        """Return this flesh with a drag."""
        other = copy.copy(self)
        other._drag = drag
        return other

    def driven_by(self, term: EnergyTerm, passive: Floats) -> Flesh:
        """Return this flesh with another first term, ``passive`` being its controls at rest."""
        other = copy.copy(self)
        other._first = term
        other._passive = passive
        return other

    @property
    def size(self) -> int:
        """Return the number of free coordinates, three per free vertex."""
        return 3 * len(self.free)

    @cached_property
    def free_coordinates(self) -> Ints:
        """Return the places (size,) of the free coordinates among all (3 p,)."""
        return np.asarray((3 * self.free[:, None] + np.arange(3)).ravel())

    def free_block(self, matrix: sp.csr_array) -> sp.csr_array:
        """Return the free coordinates' part (size, size) of a matrix (3 p, 3 p)."""
        found = sp.csr_array(matrix[self.free_coordinates][:, self.free_coordinates])
        found.sum_duplicates()
        return found

    @cached_property
    def force_scale(self) -> float:
        """Return the size of the nodal forces at unit strain, which measures residuals."""
        steepness = np.linalg.norm(self.gradients, axis=(1, 2))
        return float(np.linalg.norm(self.elements.mu * self.volumes * steepness))

    def passive(self) -> Floats:
        """Return the controls of a face at rest: activations (n, 6) unless others drive it."""
        return self._passive.copy()

    def add_motion(self, x: Floats, motion: Floats) -> Floats:
        """Return a copy of x (p, 3) with the free vertices moved by ``motion`` (size,)."""
        x = x.copy()
        x[self.free] += motion.reshape(-1, 3)
        return x

    def energy(self, x: Floats, a: Floats) -> float:
        """Return E(x, a); infinite if a tet is inverted."""
        others = sum(each.term.energy(x, a) for each in self._others)
        drag = self._drag.energy(x) if self._drag else 0.0
        return self._first.energy(x, a) + others + drag

    def gradient(self, x: Floats, a: Floats) -> Floats:
        """Return dE/dx by the free coordinates, shape (size,)."""
        gradient = self.scatter(self._first.forces(x, a))
        for each in self._others:
            gradient += each.vertex_sum(each.term.forces(x, a))
        if self._drag:
            gradient += self._drag.gradient(x)
        return gradient

    @cached_property
    def scatter(self) -> VertexSum:
        """Return what sums (n, 4, 3, ...) over the tets of each free vertex: (size, ...)."""
        return VertexSum(self.free_numbers[self.tets], len(self.free))

    def hessian(self, x: Floats, a: Floats, *, project: float = 0.0) -> sp.csr_array:
        """Return d2E/dx2 by the free coordinates; ``project`` is :meth:`EnergyTerm.blocks`'."""
        matrix = self.block_sum(self._first.blocks(x, a, project=project))
        for each in self._others:
            each.block_sum.add(each.term.blocks(x, a, project=project), matrix.data)
        if self._drag:
            matrix.data += self._drag.hessian_values()
        return matrix

    def coupling(self, x: Floats, a: Floats, motion: Floats) -> Floats:
        """Return the free gradient's change (size, k) as held vertices move by (p, 3, k)."""
        moving = np.abs(motion).max(axis=(1, 2)) > 0.0
        out = np.zeros((len(self.free), 3, motion.shape[2]))
        for term in self.terms:
            touched = np.flatnonzero(moving[term.vertices].any(axis=1))
            vertices = term.vertices[touched]
            if len(touched):
                blocks = term.blocks(x, a, some=touched)
                couple(blocks, vertices, self.free_numbers[vertices], motion, out)
        return out.reshape(self.size, -1)

    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csr_array:
        """Return d(dE/dx)/d(controls), (size, k): k controls, an array of activations in turn."""
        found = (term.forces_by_control(x, controls) for term in self.terms)
        nothing = sp.csr_array((x.size, controls.size))
        total = sum((each for each in found if each is not None), nothing)
        return sp.csr_array(sp.csr_array(total)[self.free_coordinates])

    def jacobians(self, x: Floats) -> Floats:
        """Return det F of every tet, (n,); where flesh has grown, that of F F_p^-1."""
        out = np.empty(len(self.tets))
        elements.jacobians(self.elements, np.ascontiguousarray(x), out)
        return out

    def min_jacobian_ratio(self, x: Floats, y: Floats) -> float:
        """Return min J(y) / min(J(x), J0) over all tets, J0 being where the barrier starts."""
        return float(elements.min_jacobian_ratio(self.elements, x, y))

    def count_inverted(self, x: Floats) -> int:
        """Return how many tets have det F <= 0."""
        return int((self.jacobians(x) <= 0.0).sum())

    @cached_property
    def block_sum(self) -> BlockSum:
        """Return what sums the tets' blocks up."""
        return BlockSum(self.free_numbers[self.tets], len(self.free))
