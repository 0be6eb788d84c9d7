"""Contraction: how much muscles shorten along their fibres, the one figure of who pulls.

The contraction of a muscle, or of a compartment, under its activation a_j is

    c_j = 1 - T_j : S(a_j),

T_j being the mean of d d^T along its fibres d: the part of their length that they lose, negative
where they lengthen. A whole muscle counts by the compartment that contracts most.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from solver.fitting.drives.admissible import ADMISSIBLE
from solver.fitting.face import Face
from solver.fitting.stretches import COLUMN, FROBENIUS, ROW, fibre_tensors
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class StillOptions:
    """Contractions between which a muscle counts as holding still."""

    least: float = 0.02  # from which it contracts
    # beyond which it lengthens: a muscle that has nothing to do in an admissible fit is often
    # stretched up to the bound of its fibres, which is no motion of its own
    lengthened: float = 1.2 * (ADMISSIBLE.fibre - 1.0)

    def is_still(self, contraction: float) -> bool:
        """Tell whether a muscle with this contraction holds still."""
        return -self.lengthened < contraction < self.least


STILL = StillOptions()


@dataclass(frozen=True)
class Contraction:
    """Contractions of m muscles; ``tensors`` (m, 3, 3) are T, NaN without fibres."""

    tensors: Floats

    @classmethod
    def of(cls, model: SubjectModel, volumes: Floats, S: sp.csr_array) -> Contraction:
        """Measure contractions along a model's fibres, as S blends them over tets' ``volumes``."""
        return cls(fibre_tensors(model, volumes, S))

    @classmethod
    def of_face(cls, face: Face) -> Contraction | None:
        """Measure contractions of a face's muscles; None if these have no shapes S(a)."""
        if face.layout.drive.penalty is None:  # no shapes S(a)
            return None
        return cls.of(face.model, face.flesh.volumes, face.S)

    @cached_property
    def _along(self) -> Floats:
        """The derivative (m, 6) of T_j : S(a_j)."""
        return np.asarray(FROBENIUS * self.tensors[:, ROW, COLUMN])

    def __call__(self, a: Floats) -> Floats:
        """Return the contractions (..., m) of activations (..., m, 6), NaN without fibres."""
        return np.asarray(1.0 - (self._along * a).sum(axis=-1))

    def sd(self, covariance: Floats) -> Floats:
        """Return their standard deviations (m,) by the activations' ``covariance`` (6 m, 6 m)."""
        count = len(self.tensors)
        blocks = covariance.reshape(count, 6, count, 6)[range(count), :, range(count)]
        variance = np.einsum("jp,jpq,jq->j", self._along, blocks, self._along)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
