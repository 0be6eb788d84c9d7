"""Muscles of one degree of freedom: contraction along the fibres, as most models of faces have it.

The model that Phace (2017) compares its six degrees of freedom with. A muscle j that contracts by
gamma_j turns its part of a tet, with fibres along f, into

    S_j = gamma_j f f^T + gamma_j^(-1/2) (I - f f^T),

which keeps its volume; A_i = s_i0 I + sum_j s_ij S_j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.fitting.controls import Block, Layout, jaw_block
from solver.fitting.face import Face
from solver.fitting.skin_fit import SkinFit
from solver.fitting.stretches import FROBENIUS, entries
from solver.mechanics.boundary import BoundaryRates
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.mechanics.response import SparseControls
from solver.mechanics.terms import ElasticTerm
from solver.model import SubjectModel
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class ContractionLimits:
    """Limits of contractions."""

    least: float = 0.3  # gamma of a muscle that has shortened to a third
    most: float = 1.5  # of one that gives way to half as much again


def fibre_activations(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> Floats:
    """Return the activations (n, 6) of all tets for contractions ``gamma`` (m,); 1 is relaxed.

    Raises :class:`InputError` (``model.fibres``) for a model without fibres.
    """
    along, stretch = _along(model, S), np.concatenate([[1.0], gamma])[S.indices, None]
    across = 1.0 / np.sqrt(stretch)
    by_entry = S.data[:, None] * (across * IDENTITY + (stretch - across) * along)
    return np.asarray(np.add.reduceat(by_entry, S.indptr[:-1]))


def activation_rates(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> sp.csr_array:
    """Return the derivative (6 n, m) of :func:`fibre_activations`, each tet's entries in turn."""
    rows, columns = S.tocoo().coords
    active = np.flatnonzero(columns > 0)
    tets, muscles = rows[active], columns[active] - 1
    along = _along(model, S)[active]
    across = -0.5 * gamma[muscles, None] ** -1.5
    rates = S.data[active, None] * (along + across * (IDENTITY - along))
    places = (6 * tets[:, None] + np.arange(6)).ravel(), np.repeat(muscles, 6)
    return sp.csr_array((rates.ravel(), places), shape=(6 * S.shape[0], len(gamma)))


class _FibreContractions:
    """The law of the tets, an ``EnergyTerm``, by contractions gamma (m,)."""

    def __init__(self, elastic: ElasticTerm, model: SubjectModel, S: sp.csr_array) -> None:
        self._elastic, self._model, self._S = elastic, model, S

    @property
    def vertices(self) -> Ints:
        return self._elastic.vertices

    def energy(self, x: Floats, controls: Floats) -> float:
        return self._elastic.energy(x, self._activations(controls))

    def forces(self, x: Floats, controls: Floats) -> Floats:
        return self._elastic.forces(x, self._activations(controls))

    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        return self._elastic.blocks(x, self._activations(controls), project=project, some=some)

    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        by_activation = self._elastic.forces_by_control(x, self._activations(controls))
        return sp.csc_array(by_activation @ activation_rates(self._model, self._S, controls))

    def _activations(self, gamma: Floats) -> Floats:
        return fibre_activations(self._model, self._S, gamma)


def driven_by_fibres(face: Face) -> Flesh:
    """Return a face's flesh with contractions (m,) of its muscles for controls."""
    term = _FibreContractions(face.flesh.elastic, face.model, face.S)
    return face.flesh.driven_by(term, np.ones(face.model.muscle_count))


def nearest_fibre(
    model: SubjectModel,
    S: sp.csr_array,
    a: Floats,
    options: ContractionLimits = ContractionLimits(),
) -> Floats:
    """Return the contractions (m,) along the fibres that activations ``a`` (m, 6) come to.

    They are f^T S(a_j) f, its mean over the muscle's volume, within the ``options``' limits.
    Raises as :func:`fibre_activations`.
    """
    (rows, columns), along = S.tocoo().coords, _along(model, S)
    stretch = np.einsum("ek,k,ek->e", along, FROBENIUS, np.vstack([IDENTITY, a])[columns])
    weight = S.data * volumes(model.rest, model.tets)[rows]
    whole, sums = (np.bincount(columns, w, S.shape[1]) for w in (weight, weight * stretch))
    found = np.divide(sums, whole, out=np.ones_like(whole), where=whole > 0.0)
    return np.asarray(np.clip(found, options.least, options.most)[1:])


def _along(model: SubjectModel, S: sp.csr_array) -> Floats:
    """Return f f^T (nnz, 6) of every stored entry of S."""
    if model.fibres is None or len(model.fibres) != S.nnz:
        raise InputError(
            "model.fibres", "the model has no fibre directions: build it again to use fibre muscles"
        )
    return entries(model.fibres)


@dataclass(frozen=True)
class FibreFit:
    """Contractions ``gamma`` (m,), the ``jaw`` (5,), and vertices ``x`` (p, 3) they lead to."""

    gamma: Floats
    jaw: Floats
    x: Floats


class FibreControls:
    """Contractions along fibres and the jaw: :class:`solver.fitting.controls.FitControls`."""

    def __init__(self, face: Face, options: ContractionLimits = ContractionLimits()) -> None:
        self._face = face
        self.flesh = driven_by_fibres(face)
        relaxed = np.ones(face.model.muscle_count)
        contractions = Block("contractions", relaxed, lower=options.least, upper=options.most)
        self.layout = Layout((contractions, jaw_block()))

    def flesh_controls(self, q: Floats) -> Floats:
        """See :class:`solver.fitting.controls.FitControls`."""
        return self.layout.part("contractions", q)

    def held_positions(self, q: Floats) -> Floats:
        """See :class:`solver.fitting.controls.FitControls`."""
        return self._face.held_positions(self.layout.part("jaw", q))

    def linearise(self, q: Floats, x: Floats) -> SparseControls:
        """See :class:`solver.fitting.controls.FitControls`."""
        gamma, b = self.layout.split(q)
        by_jaw = np.eye(self.layout.size)[self.layout["jaw"]]
        direct = self._face.mandible_jacobian(b)[self.flesh.held]
        rates = sp.eye_array(len(gamma), self.layout.size, format="csr")
        boundary = BoundaryRates(direct @ by_jaw, by_jaw)
        return SparseControls.of(self.flesh, x, gamma, rates, boundary)


def fit_fibres(
    face: Face, target: Floats, options: ContractionLimits = ContractionLimits()
) -> FibreFit:
    """Fit the face's points (k, 3) to ``target``, mm; raises as :func:`fibre_activations`."""
    controls = FibreControls(face, options)
    found = SkinFit(face, controls, target).solve().point
    gamma, jaw = controls.layout.split(found.q)
    return FibreFit(gamma, jaw, found.equilibrium.x)
