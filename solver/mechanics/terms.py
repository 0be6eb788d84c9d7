"""Terms of the flesh's energy: what a flesh sums up, the law of its tets being the first.

A term is a sum over entries, each of the vertices of one tet or of one vertex alone (on a spring
or a plane), so that the Hessian keeps the tets' pattern. All terms see the same controls:
activations of the tets (n, 6) or of muscles (m,). What meets skin or objects has no fixed pattern
and is a :class:`solver.mechanics.boundary.Potential`.
"""

from __future__ import annotations

import threading
from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import InputError, SolveError
from solver.mechanics import elements, laws
from solver.mechanics.assembly import PAIRS
from solver.mechanics.elements import Elements
from solver.mechanics.linalg3 import symmetric_determinant
from solver.surface import Floats, Ints


class EnergyTerm(Protocol):
    """A part of the energy of vertices x (p, 3), by controls: a sum over e entries."""

    vertices: Ints  # each entry's: (e, 4), those of a tet, or (e, 1)

    def energy(self, x: Floats, controls: Floats) -> float:
        """Return the energy, infinite where x is not feasible."""

    def forces(self, x: Floats, controls: Floats) -> Floats:
        """Return the gradient by each entry's vertices, (e, v, 3); the next call may overwrite."""

    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        """Return the second derivatives (e, v (v + 1) / 2, 3, 3) by the pairs u <= v of vertices.

        The pairs are in the order of ``np.triu_indices(v)``; a block's rows are u's coordinates.

        ``project`` goes from 0, as they are, to 1, positive semi-definite; ``some`` are the entries
        that are asked for. The next call may overwrite the result.
        """

    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array | None:
        """Return the gradient's derivative by the controls (3 p, k); None where there is none."""


class InvertedActivationError(InputError, SolveError):
    """A tet is activated to no positive volume: to a fit, a step that went too far."""


class KeptArrays(threading.local):
    """Memory of each thread for the results of ``count`` tets: fresh one costs what they cost."""

    def __init__(self, count: int) -> None:
        self.forces = np.empty((count, 4, 3))
        self.blocks = np.empty((count, PAIRS, 3, 3))


class ElasticTerm(EnergyTerm):
    """The law of all tets; its controls are activations (n, 6)."""

    def __init__(self, mesh: Elements) -> None:
        self._mesh = mesh
        self.vertices = mesh.tets
        self._kept = KeptArrays(len(mesh.tets))

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        out = np.empty(len(self._mesh.tets))
        elements.energies(self._mesh, np.ascontiguousarray(x), controls, out)
        return float(out.sum())

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        """Differentiate; raises :class:`InvertedActivationError`."""
        self._check(controls)
        elements.forces(self._mesh, np.ascontiguousarray(x), controls, self._kept.forces)
        return self._kept.forces

    @override
    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        """Differentiate; raises :class:`InvertedActivationError`."""
        self._check(controls)
        mesh = self._mesh
        out = self._kept.blocks
        if some is not None:
            mesh = mesh.take(some)
            controls = controls[some]
            out = np.empty((len(some), PAIRS, 3, 3))
        elements.hessian_blocks(mesh, np.ascontiguousarray(x), controls, float(project), out)
        return out

    def forces_by_activation(self, x: Floats, a: Floats) -> Floats:
        """Return the derivative by each tet's activation of its forces, (n, 4, 3, 6)."""
        self._check(a)
        out = np.empty((len(a), 4, 3, 6))
        elements.forces_by_activation(self._mesh, np.ascontiguousarray(x), a, out)
        return out

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return (3 p, 6 n), each tet's six entries in turn."""
        by_tet = self.forces_by_activation(x, controls).transpose(0, 3, 1, 2)
        vertices = np.repeat(self._mesh.tets, 6, axis=0)
        return force_columns(by_tet.reshape(-1, 4, 3), vertices, x.size)

    def _check(self, a: Floats) -> None:
        if laws.needs_volume(self._mesh.law) and not elements.min_activated_volume(a) > 0.0:
            tet = int(np.argmin([symmetric_determinant(tuple(each)) for each in a]))
            message = f"tet number {tet} is activated to no positive volume"
            raise InvertedActivationError("material.activation", message)


class RestingTerm(EnergyTerm):
    """The law of tets whose activations ``a`` (n, 6) stay as they are."""

    def __init__(self, elastic: ElasticTerm, a: Floats) -> None:
        self._elastic = elastic
        self._a = a
        self.vertices = elastic.vertices

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        return self._elastic.energy(x, self._a)

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        return self._elastic.forces(x, self._a)

    @override
    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        return self._elastic.blocks(x, self._a, project=project, some=some)

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> None:
        return None


class PassiveTerm(EnergyTerm):
    """A term that no control changes, quadratic in x."""

    @abstractmethod
    def stiffness_of(self, some: Ints | slice) -> Floats:
        """Return the second derivatives of some entries, as :meth:`blocks` has them."""

    @override
    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        return self.stiffness_of(slice(None) if some is None else some)

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> None:
        return None


class Springs(PassiveTerm):
    """Springs without length that pull vertices to places of their own.

    E = sum_k s_k / 2 |x_k - centre_k|^2 over ``vertices`` (k, 1), with ``centre`` (k, 3) and
    ``stiffness`` s (k,) in Pa mm.
    """

    def __init__(self, vertices: Ints, centre: Floats, stiffness: Floats) -> None:
        self.vertices = vertices
        self.centre = centre
        self.stiffness = stiffness

    def places(self, _controls: Floats) -> Floats:
        """Return where the vertices are pulled to, (k, 3)."""
        return self.centre

    def _drift(self, x: Floats, controls: Floats) -> Floats:
        return np.asarray(x[self.vertices[:, 0]] - self.places(controls))

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        return 0.5 * float(self.stiffness @ (self._drift(x, controls) ** 2).sum(axis=1))

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        return np.asarray((self.stiffness[:, None] * self._drift(x, controls))[:, None])

    @override
    def stiffness_of(self, some: Ints | slice) -> Floats:
        return self.stiffness[some, None, None, None] * np.eye(3)


@dataclass(frozen=True)
class SlidingPlanes(PassiveTerm):
    """Flesh that slides on a bone: vertices stay on planes, and move freely in them.

        E = sum_k stiffness_k / 2 ((x_k - point_k) . normal_k)^2

    is the constraint of Phace (SIGGRAPH 2017), a point on the plane through its rest position.
    """

    vertices: Ints  # (k, 1)
    points: Floats  # (k, 3)
    normals: Floats  # (k, 3), of unit length
    stiffness: Floats  # (k,) in stress units times mm

    def drift(self, x: Floats) -> Floats:
        """Return how far the vertices ``x`` (p, 3) have left their planes, (k,) mm."""
        return np.asarray(((x[self.vertices[:, 0]] - self.points) * self.normals).sum(axis=1))

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        return float(0.5 * self.stiffness @ self.drift(x) ** 2)

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        along = self.stiffness * self.drift(x)
        return np.asarray(along[:, None] * self.normals)[:, None]

    @override
    def stiffness_of(self, some: Ints | slice) -> Floats:
        normals = self.normals[some]
        stiffness = self.stiffness[some]
        outer = normals[:, :, None] * normals[:, None, :]
        return np.asarray((stiffness[:, None, None] * outer)[:, None])


def planes(
    rest: Floats,
    tets: Ints,
    vertices: Ints,
    normals: Floats,
    mu: Floats | float,
    ratio: float = 1000.0,
) -> SlidingPlanes:
    """Return the planes through the rest positions of ``vertices`` (k,), with their stiffness.

    ``rest`` (p, 3) and ``tets`` (n, 4) are the flesh's, ``mu`` is that of all tets or of each (n,).
    ``ratio`` is the stiffness along the normals (k, 3) over that of flesh: a stress of mu lifts a
    vertex off the bone by a thousandth of its tets' size.
    """
    volume = np.abs(np.linalg.det(rest[tets[:, 1:]] - rest[tets[:, :1]])) / 6.0
    # mu times the size of what is around a vertex, cubed
    cubes = np.bincount(tets.ravel(), np.repeat(mu**3 * volume / 4.0, 4), len(rest))
    stiffness = ratio * np.cbrt(cubes[vertices])
    return SlidingPlanes(vertices[:, None], rest[vertices], normals, stiffness)


def no_planes() -> SlidingPlanes:
    """Return the planes of flesh that slides nowhere."""
    nothing = np.zeros((0, 3))
    return SlidingPlanes(np.zeros((0, 1), dtype=np.int64), nothing, nothing, np.zeros(0))


def force_columns(forces: Floats, vertices: Ints, size: int) -> sp.csc_array:
    """Return (size, k) with the ``forces`` (k, v, 3) on some vertices in each column.

    ``vertices`` (k, v) are their numbers, -1 for one that is left out.
    """
    rows = 3 * vertices[:, :, None] + np.arange(3)
    # what is left out is zeroed and goes to row 0
    out = rows < 0
    values = np.where(out, 0.0, forces)
    rows = np.where(out, 0, rows)
    indptr = rows.shape[1] * 3 * np.arange(len(forces) + 1)
    return sp.csc_array((values.ravel(), rows.ravel(), indptr), shape=(size, len(forces)))


@dataclass(frozen=True)
class TermCheckOptions:
    """Accuracy of :func:`check_term`."""

    step_mm: float = 1e-4  # of central differences
    tolerance: float = 1e-4  # of the largest value, relative
    rounding: float = 1e-10  # of an energy, relative


def check_entries(term: EnergyTerm, count: int, tets: Ints | None = None) -> None:
    """Raise :class:`InputError` (``face.energy``) unless a term is one of ``count`` vertices.

    Entries of four are vertices of one of the ``tets`` (n, 4), if these are given.
    """
    name = type(term).__name__
    needed = ("vertices", "energy", "forces", "blocks", "forces_by_control")
    if missing := [each for each in needed if not hasattr(term, each)]:
        raise _term_error(f"{name} is no term of the energy: it has no {', '.join(missing)}")
    vertices = np.asarray(term.vertices)
    if vertices.ndim != 2 or vertices.shape[1] not in (1, 4) or vertices.dtype.kind not in "iu":
        found = f"{vertices.dtype} of shape {vertices.shape}"
        raise _term_error(f"the vertices of {name} are {found}, not whole numbers (e, 1) or (e, 4)")
    for entry in np.flatnonzero(((vertices < 0) | (vertices >= count)).any(axis=1))[:1]:
        numbers = vertices[entry].tolist()
        raise _term_error(f"entry {entry} of {name} has vertices {numbers} of {count}")
    if tets is not None and vertices.shape[1] > 1:
        known = set(map(tuple, np.sort(tets).tolist()))
        for entry, four in enumerate(np.sort(vertices).tolist()):
            if tuple(four) not in known:
                raise _term_error(f"the vertices {four} of {name}, entry {entry}, are no tet's")


def check_term(
    term: EnergyTerm,
    x: Floats,
    controls: Floats | None = None,
    options: TermCheckOptions = TermCheckOptions(),
) -> None:
    """Compare a term's forces with its energy at x (p, 3), and its blocks with its forces.

    By differences in a random direction. Raises :class:`InputError` (``face.energy``) for other
    shapes than :class:`EnergyTerm` has, and where they differ.
    """
    check_entries(term, len(x))
    a = np.zeros((0, 6)) if controls is None else controls
    name = type(term).__name__
    vertices = np.asarray(term.vertices)
    h = options.step_mm
    u, v = np.triu_indices(vertices.shape[1])
    forces = np.array(term.forces(x, a))
    blocks = np.array(term.blocks(x, a))
    for what, found, shape in (
        ("forces", forces, (*vertices.shape, 3)),
        ("blocks", blocks, (len(vertices), len(u), 3, 3)),
        ("blocks of some", np.array(term.blocks(x, a, some=np.arange(1))), (1, len(u), 3, 3)),
    ):
        if found.shape != shape:
            raise _term_error(f"the {what} of {name} have the shape {found.shape}, not {shape}")
    motion = np.random.default_rng(0).standard_normal(x.shape)
    way, (ahead, behind) = motion[vertices], (x + h * motion, x - h * motion)
    ends = term.energy(ahead, a), term.energy(behind, a)
    expected = (ends[0] - ends[1]) / (2.0 * h)
    by_forces = float((forces * way).sum())
    rounding = options.rounding / h
    allowed = options.tolerance * max(abs(expected), abs(by_forces)) + rounding * max(
        abs(ends[0]), abs(ends[1])
    )
    if not abs(by_forces - expected) <= allowed:
        message = f"its energy changes by {expected:.6g} a mm, its forces say {by_forces:.6g}"
        raise _term_error(f"the forces of {name} are not its energy's gradient: {message}")
    change = (np.array(term.forces(ahead, a)) - term.forces(behind, a)) / (2.0 * h)
    product = np.zeros_like(forces)
    for pair, (first, second) in enumerate(zip(u, v, strict=True)):
        product[:, first] += np.einsum("eij,ej->ei", blocks[:, pair], way[:, second])
        if first != second:
            product[:, second] += np.einsum("eji,ej->ei", blocks[:, pair], way[:, first])
    allowed = options.tolerance * np.abs(change).max() + rounding * np.abs(forces).max()
    wrong = ~(np.abs(product - change) <= allowed).all(axis=(1, 2))
    for entry in np.flatnonzero(wrong)[:1]:
        message = f"the blocks of {name} are not its forces' derivative, first in entry {entry}"
        raise _term_error(message)


def _term_error(message: str) -> InputError:
    return InputError("face.energy", message)
