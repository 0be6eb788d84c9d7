"""Contraction along the fibres, one number a muscle, as most models of faces have it.

The drive that Phace (2017) compares its six degrees of freedom with. A muscle j that contracts by
gamma_j turns its part of a tet, with fibres along f, into

    S_j = gamma_j f f^T + gamma_j^(-1/2) (I - f f^T),

which keeps its volume; A_i = s_i0 I + sum_j s_ij S_j.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.anatomy.muscle_weights import volumes_by_muscle
from solver.anatomy.tetrahedra import volumes
from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.activation import UNSEEN_STOP, ActivationFit
from solver.fitting.controls import Block
from solver.fitting.drives import ContractionMap, MuscleDrive
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.stretches import FROBENIUS, entries
from solver.fitting.tet_forces import MatrixRates, MuscleRates, TetForces
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class ContractionLimits:
    """Limits of contractions, and the weight of a fit's rest."""

    least: float = 0.3  # gamma of a muscle that has shortened to a third
    most: float = 1.5  # of one that gives way to half as much again
    w_rest: float = 2e-2  # mm^2 by the square of a contraction


def fibre_activations(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> Floats:
    """Return the activations (n, 6) of all tets for contractions ``gamma`` (m,); 1 is relaxed.

    Raises :class:`InputError` (``model.fibres``) for a model without fibres.
    """
    along = _along(model, S)
    stretch = np.concatenate([[1.0], gamma])[S.indices, None]
    across = 1.0 / np.sqrt(stretch)
    by_entry = S.data[:, None] * (across * IDENTITY + (stretch - across) * along)
    return np.asarray(np.add.reduceat(by_entry, S.indptr[:-1]))


def activation_rates(model: SubjectModel, S: sp.csr_array, gamma: Floats) -> sp.csr_array:
    """Return the derivative (6 n, m) of :func:`fibre_activations`, each tet's entries in turn."""
    rows, columns = S.tocoo().coords
    active = np.flatnonzero(columns > 0)
    tets = rows[active]
    muscles = columns[active] - 1
    along = _along(model, S)[active]
    across = -0.5 * gamma[muscles, None] ** -1.5
    rates = S.data[active, None] * (along + across * (IDENTITY - along))
    places = (6 * tets[:, None] + np.arange(6)).ravel(), np.repeat(muscles, 6)
    return sp.csr_array((rates.ravel(), places), shape=(6 * S.shape[0], len(gamma)))


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
class FibreContraction(MuscleDrive, name="contraction"):
    """Contractions (m,) of a model's muscles within limits; 1 is relaxed."""

    model: SubjectModel
    limits: ContractionLimits = ContractionLimits()

    @override
    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        relaxed = np.ones(S.shape[1] - 1)
        limits = self.limits
        return Block("contractions", relaxed, lower=limits.least, upper=limits.most, role="muscles")

    @override
    def attach(self, flesh: Flesh) -> Flesh:
        return flesh

    @override
    def controls(self, S: sp.csr_array, a: Floats) -> Floats:
        return fibre_activations(self.model, S, a)

    @override
    def rates(self, forces: TetForces) -> MuscleRates:
        by_activation = forces.flesh.forces_by_control(forces.x, forces.controls)
        rates = activation_rates(self.model, forces.S, forces.a)
        return MatrixRates(sp.csr_array(by_activation @ rates))

    @override
    def contraction_map(
        self, model: SubjectModel, volumes: Floats, S: sp.csr_array
    ) -> ContractionMap:
        return ContractionMap(np.full((S.shape[1] - 1, 1), -1.0), volumes_by_muscle(volumes, S))

    @override
    def settings(self) -> dict[str, Any]:
        return {"limits": asdict(self.limits)}

    @override
    @classmethod
    def restored(
        cls, settings: Mapping[str, Any], model: SubjectModel, S: sp.csr_array
    ) -> FibreContraction:
        return cls(model, ContractionLimits(**settings["limits"]))


def fit_contractions(
    face: Face, target: Floats, options: ContractionLimits = ContractionLimits()
) -> ActivationFit:
    """Fit the face's points (k, 3) to ``target``, mm, by contractions and the jaw.

    Raises as :func:`fibre_activations`.
    """
    driven = face.driven_by(FibreContraction(face.model, options))
    prior = Regulariser(w_a=options.w_rest, w_v=0.0, w_b=1e-6, prior=driven.rest_pose())
    data = SkinDistance(driven, Target.from_points(target))
    return activation.fit(driven, data, prior, options=UNSEEN_STOP)
