"""Muscles of one degree of freedom: contraction along the fibres, as most models of faces have it.

The model that Phace (2017) compares its six degrees of freedom with. A muscle j that contracts by
gamma_j turns its part of a tet, with fibres along f, into

    S_j = gamma_j f f^T + gamma_j^(-1/2) (I - f f^T),

which keeps its volume; A_i = s_i0 I + sum_j s_ij S_j.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.optimize import lsq_linear

from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.fitting.stretches import COLUMN, FROBENIUS, ROW
from solver.mechanics import equilibrium
from solver.mechanics.equilibrium import Equilibrium
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.mechanics.potential import BoundaryRates
from solver.mechanics.response import Response, SparseControls
from solver.mechanics.terms import ElasticTerm
from solver.model import SubjectModel
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class FibreOptions:
    """Limits of contractions, and how they are fitted."""

    least: float = 0.3  # gamma of a muscle that has shortened to a third
    most: float = 1.5  # of one that gives way to half as much again
    # weight of relaxed muscles and a closed jaw, in mm^2 by rad^2 or mm^2 or contraction^2
    rest: float = 1e-2
    steps: int = 12  # at most
    shortest: float = 2.0**-4  # part of a step below which it is given up
    gain: float = 1e-3  # part of the distance that a step gains at least, or it is the last
    rounding: float = 1e-9  # a limit that is reached leaves this much room


def fibre_activations(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> Floats:
    """Return the activations (n, 6) of all tets for contractions ``gamma`` (m,); 1 is relaxed.

    Raises :class:`InputError` (``model.fibres``) for a model without fibres.
    """
    rows, columns = _entries(S)
    along = _along(model, S)
    stretch = np.concatenate([[1.0], gamma])[columns]
    across = 1.0 / np.sqrt(stretch)
    entries = S.data * (stretch - across)
    active = np.stack(
        [np.bincount(rows, entries * along[:, k], minlength=S.shape[0]) for k in range(6)], axis=1
    )
    isotropic = np.bincount(rows, S.data * across, minlength=S.shape[0])
    return np.ascontiguousarray(active + isotropic[:, None] * IDENTITY)


def activation_rates(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> sp.csr_array:
    """Return the derivative (6 n, m) of :func:`fibre_activations`, each tet's entries in turn."""
    rows, columns = _entries(S)
    active = np.flatnonzero(columns > 0)
    tets, muscles = rows[active], columns[active] - 1
    along = _along(model, S)[active]
    across = -0.5 * gamma[muscles, None] ** -1.5
    rates = S.data[active, None] * (along + across * (IDENTITY - along))
    places = 6 * tets[:, None] + np.arange(6), np.repeat(muscles[:, None], 6, axis=1)
    shape = (6 * S.shape[0], len(gamma))
    return sp.csr_array((rates.ravel(), tuple(map(np.ravel, places))), shape=shape)


class FibreContractions:
    """Flesh driven by contractions gamma (m,) along fibres, an ``EnergyTerm`` of its tets.

    It is the law of the tets, ``elastic``, with the activations that the contractions come to.
    """

    def __init__(self, elastic: ElasticTerm, model: SubjectModel, S: sp.csr_array) -> None:
        self._elastic = elastic
        self._model = model
        self._S = S

    @property
    def vertices(self) -> Ints:
        """See :class:`solver.mechanics.terms.EnergyTerm`."""
        return self._elastic.vertices

    def energy(self, x: Floats, controls: Floats) -> float:
        """See :class:`solver.mechanics.terms.EnergyTerm`."""
        return self._elastic.energy(x, self._activations(controls))

    def forces(self, x: Floats, controls: Floats) -> Floats:
        """See :class:`solver.mechanics.terms.EnergyTerm`."""
        return self._elastic.forces(x, self._activations(controls))

    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        """See :class:`solver.mechanics.terms.EnergyTerm`."""
        return self._elastic.blocks(x, self._activations(controls), project=project, some=some)

    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        """See :class:`solver.mechanics.terms.EnergyTerm`."""
        by_activation = self._elastic.forces_by_control(x, self._activations(controls))
        return sp.csc_array(by_activation @ activation_rates(self._model, self._S, controls))

    def _activations(self, gamma: Floats) -> Floats:
        return fibre_activations(self._model, self._S, gamma)


def driven_by_fibres(face: Face) -> Flesh:
    """Return a face's flesh with contractions (m,) of its muscles for controls."""
    term = FibreContractions(face.flesh.elastic, face.model, face.S)
    return face.flesh.driven_by(term, np.ones(face.model.muscle_count))


def nearest_fibre(
    model: SubjectModel, S: sp.csr_array, a: Floats, options: FibreOptions = FibreOptions()
) -> Floats:
    """Return the contractions (m,) along the fibres that activations ``a`` (m, 6) come to.

    They are f^T S(a_j) f, its mean over the muscle's volume, within the ``options``' limits.
    Raises as :func:`fibre_activations`.
    """
    rows, columns = _entries(S)
    along = _along(model, S)
    stretch = np.einsum("ek,k,ek->e", along, FROBENIUS, np.vstack([IDENTITY, a])[columns])
    weight = S.data * volumes(model.rest, model.tets)[rows]
    count = S.shape[1]
    whole = np.bincount(columns, weight, minlength=count)
    sums = np.bincount(columns, weight * stretch, minlength=count)
    found = np.where(whole > 0.0, sums / np.where(whole > 0.0, whole, 1.0), 1.0)
    return np.asarray(np.clip(found, options.least, options.most)[1:])


def _entries(S: sp.csr_array) -> tuple[Ints, Ints]:
    """Return row and column (nnz,) of every stored entry."""
    return np.repeat(np.arange(S.shape[0]), np.diff(S.indptr)), np.asarray(S.indices, np.int64)


def _along(model: SubjectModel, S: sp.csr_array) -> Floats:
    """Return f f^T (nnz, 6) of every stored entry of S."""
    if model.fibres is None or len(model.fibres) != S.nnz:
        raise InputError(
            "model.fibres", "the model has no fibre directions: build it again to use fibre muscles"
        )
    return np.asarray(model.fibres[:, ROW] * model.fibres[:, COLUMN])


# Fitting fibre muscles to a target skin: one contraction a muscle, and the jaw.
#
# Gauss-Newton on the mean square distance of the face's vertices, the equilibrium x(gamma, b) being
# differentiated as everywhere: dx/dtheta = -H^-1 d(grad E)/dtheta.


@dataclass(frozen=True)
class FibreFit:
    """Contractions ``gamma`` (m,), the ``jaw`` (5,), and vertices ``x`` (p, 3) they lead to."""

    gamma: Floats
    jaw: Floats
    x: Floats


def fit_fibres(face: Face, target: Floats, options: FibreOptions = FibreOptions()) -> FibreFit:
    """Fit the face's points (k, 3) to ``target`` (k, 3) from rest, in mm.

    Raises :class:`~solver.errors.InputError` (``model.fibres``) for a model without fibres.
    """
    return _Fit(face, target, options).solve()


class _Fit:
    """Unknowns theta (m + 5,) are contractions and jaw."""

    def __init__(self, face: Face, target: Floats, options: FibreOptions = FibreOptions()) -> None:
        self._options = options
        self._face = face
        self._flesh = driven_by_fibres(face)
        self._target = target
        muscles = face.model.muscle_count
        self._relaxed = np.concatenate([np.ones(muscles), np.zeros(5)])
        self._low = np.concatenate([np.full(muscles, options.least), np.full(5, -np.inf)])
        self._high = np.concatenate([np.full(muscles, options.most), np.full(5, np.inf)])

    def solve(self) -> FibreFit:
        theta = self._relaxed
        state = self.settle(theta, self._face.model.rest)
        for _ in range(self._options.steps):
            before = self._value(theta, state)
            found = self._search(theta, self._step(theta, state), state, before)
            if found is None:
                break
            theta, state = found
            if self._value(theta, state) > (1.0 - self._options.gain) * before:
                break
        return FibreFit(theta[:-5], theta[-5:], state.x)

    def settle(self, theta: Floats, x: Floats) -> Equilibrium:
        """Return the equilibrium of theta, found from x (p, 3)."""
        face = self._face
        x = x.copy()
        x[face.flesh.held] = face.held_positions(theta[-5:])
        return equilibrium.solve_equilibrium(
            self._flesh, face.linear, x, theta[:-5], tolerance=face.tolerance
        )

    def jacobian(self, theta: Floats, state: Equilibrium) -> Floats:
        """Return the derivative (3 k, m + 5) of the face's points by theta."""
        face, flesh = self._face, self._flesh
        gamma, by_jaw = theta[:-5], np.eye(5, len(theta), len(theta) - 5)
        boundary = BoundaryRates(face.mandible_jacobian(theta[-5:])[flesh.held] @ by_jaw, by_jaw)
        rates = sp.eye_array(len(gamma), len(theta), format="csr")
        controls = SparseControls.of(flesh, state.x, gamma, rates, boundary)
        motion = Response(flesh, state.factor).motions(controls)
        points = face.face_embedding @ motion.reshape(len(flesh.rest), -1)
        return np.asarray(points.reshape(-1, len(theta)))

    def _step(self, theta: Floats, state: Equilibrium) -> Floats:
        """Return the step of Gauss-Newton within the limits."""
        scale, pull = np.sqrt(len(self._target)), np.sqrt(self._options.rest)
        system = [self.jacobian(theta, state) / scale, pull * np.eye(len(theta))]
        right = [-self._off(state).ravel() / scale, pull * (self._relaxed - theta)]
        room = (
            self._low - theta - self._options.rounding,
            self._high - theta + self._options.rounding,
        )
        return np.asarray(lsq_linear(np.vstack(system), np.concatenate(right), room).x)

    def _search(
        self, theta: Floats, step: Floats, state: Equilibrium, before: float
    ) -> tuple[Floats, Equilibrium] | None:
        """Return where the first part of a step that gains leads to, None if none does."""
        part = 1.0
        while part >= self._options.shortest:
            tried = theta + part * step
            with suppress(SolveError):  # too far: half of it may not be
                reached = self.settle(tried, state.x)
                if self._value(tried, reached) < before:
                    return tried, reached
            part *= 0.5
        return None

    def _value(self, theta: Floats, state: Equilibrium) -> float:
        distance = (self._off(state) ** 2).sum() / len(self._target)
        return float(distance + self._options.rest * ((theta - self._relaxed) ** 2).sum())

    def _off(self, state: Equilibrium) -> Floats:
        return self._face.face_points(state.x) - self._target
