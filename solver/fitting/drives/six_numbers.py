"""Six numbers a muscle, a symmetric S(a_j), that S blends: A_i = sum_j s_ij S(a_j), a_0 = a_I.

As shapes they pay for lost volume, and for stretches that turn flesh inside out,

    w_v/2 sum_j (det S(a_j) - 1)^2 + w_e/2 sum_jk max(0, e - lambda_k(S(a_j)))^2.

The last term is ours: the flesh's barrier forbids a negative eigenvalue, and what is left are many
buckled equilibria to get caught in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.anatomy.muscle_weights import volumes_by_muscle
from solver.fitting.controls import Block, ShapePenalty, Spread
from solver.fitting.drives import ContractionMap, MuscleDrive
from solver.fitting.stretches import (
    COLUMN,
    FROBENIUS,
    ROW,
    determinant_gradients,
    determinants,
    entries,
    fibre_tensors,
    matrices,
)
from solver.fitting.tet_forces import BlendedRates, MuscleRates, TetForces
from solver.mechanics.flesh import IDENTITY, Flesh
from solver.model import SubjectModel
from solver.surface import Floats

ACTIVATION_REACH = 0.4  # change of an entry up to which a linear model is surely good
# the eigenvalue e of S(a_j) that a muscle hardly goes below: contraction to a tenth
LEAST_STRETCH = 0.1


@dataclass(frozen=True)
class SixNumbers(MuscleDrive, name="free"):
    """The published drive: any six numbers a muscle."""

    @override
    def block(self, model: SubjectModel, flesh: Flesh, S: sp.csr_array) -> Block:
        return activation_block(S.shape[1] - 1)

    @override
    def attach(self, flesh: Flesh) -> Flesh:
        return flesh

    @override
    def controls(self, S: sp.csr_array, a: Floats) -> Floats:
        return np.ascontiguousarray(S @ np.vstack([IDENTITY, a]))

    @override
    def rates(self, forces: TetForces) -> MuscleRates:
        return BlendedRates(forces)

    @override
    def contraction_map(
        self, model: SubjectModel, volumes: Floats, S: sp.csr_array
    ) -> ContractionMap | None:
        if S.shape[1] != model.muscle_count + 1:  # tets by themselves, which are no muscles
            return None
        tensors = fibre_tensors(model, volumes, S)
        return ContractionMap(-FROBENIUS * tensors[:, ROW, COLUMN], volumes_by_muscle(volumes, S))


def activation_block(muscles: int) -> Block:
    """Return the block of activations (m, 6), free."""
    rest = np.tile(IDENTITY, (muscles, 1))
    spread = Spread(template=0.03, scans=0.03, nothing=0.6)
    return Block(
        "activations",
        rest,
        reach=ACTIVATION_REACH,
        spread=spread,
        role="muscles",
        penalty=TensorPenalty(),
    )


@dataclass(frozen=True)
class TensorPenalty(ShapePenalty):
    """The price of a muscle's shape S(a_j): a :class:`~solver.fitting.controls.ShapePenalty`."""

    @override
    def value(self, a: Floats, w_v: float, w_e: float) -> float:
        det = determinants(a) - 1.0
        deficit, _ = eigenvalue_deficits(a)
        return float(0.5 * w_v * det @ det + 0.5 * w_e * np.sum(deficit**2))

    @override
    def gradient(self, a: Floats, w_v: float, w_e: float) -> Floats:
        det = determinants(a) - 1.0
        deficit, gradients = eigenvalue_deficits(a)
        by_volume = w_v * det[:, None] * determinant_gradients(a)
        return np.asarray(by_volume - w_e * np.einsum("jk,jkq->jq", deficit, gradients))

    @override
    def curvature(self, a: Floats, w_v: float, w_e: float) -> Floats:
        gradients = determinant_gradients(a)
        _, towards = eigenvalue_deficits(a)
        by_volume = w_v * gradients[:, :, None] * gradients[:, None, :]
        return np.asarray(by_volume + w_e * towards.transpose(0, 2, 1) @ towards)


def eigenvalue_deficits(a: Floats) -> tuple[Floats, Floats]:
    """Return max(0, e - lambda_k(S(a_j))), (m, 3), and where not 0 d lambda_k/da_j, (m, 3, 6)."""
    values, vectors = np.linalg.eigh(matrices(a))
    deficit = np.maximum(LEAST_STRETCH - values, 0.0)
    gradients = FROBENIUS * entries(vectors.transpose(0, 2, 1))
    return deficit, gradients * (deficit > 0.0)[:, :, None]
