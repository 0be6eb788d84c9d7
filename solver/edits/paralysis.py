"""Paralysis: muscles, or a side of the face, that contract less or not at all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.sparse as sp

from solver.edits.edit import Edited
from solver.errors import InputError
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Paralysis:
    """``muscles`` (all by default), on one ``side`` (both), keep this ``strength`` (none).

    Their shares in S are multiplied and the rest becomes passive flesh: s_ij -> g_ij s_ij. A side
    is the subject's own; it ends smoothly at the mid-plane, as some muscles cross it.
    """

    muscles: tuple[str, ...] | None = None
    side: Literal["left", "right"] | None = None
    strength: float = 0.0

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.muscle`` and ``scene.strength``."""
        if not 0.0 <= self.strength <= 1.0:
            raise InputError(
                "scene.strength",
                f"a strength lies between 0 and 1, not at {self.strength}",
                found=self.strength,
            )
        rows, columns = _entries(before.S)
        share = np.isin(columns, self._columns(before.model.muscle_names)).astype(np.float64)
        if self.side is not None:
            share *= _side(before, self.side)[rows]
        kept = before.S.data * (1.0 - (1.0 - self.strength) * share)
        weakened = sp.csr_array((kept, before.S.indices, before.S.indptr), shape=before.S.shape)
        lost = np.asarray(before.S.sum(axis=1)) - np.asarray(weakened.sum(axis=1))
        passive = columns == 0
        weakened.data[passive] += lost[rows[passive]]
        return replace(before, S=weakened)

    def _columns(self, names: tuple[str, ...]) -> Ints:
        """Return the columns of S that lose strength."""
        if self.muscles is None:
            return np.arange(1, len(names) + 1)
        unknown = [name for name in self.muscles if name not in names]
        if unknown:
            raise InputError(
                "scene.muscle",
                f"the subject has no muscle {unknown[0]!r}; it has {', '.join(names)}",
                found=unknown,
                expected=list(names),
            )
        return np.array([names.index(name) + 1 for name in self.muscles], dtype=np.int64)


def _entries(S: sp.csr_array) -> tuple[Ints, Ints]:
    """Return row and column (nnz,) of every stored entry."""
    return np.repeat(np.arange(S.shape[0]), np.diff(S.indptr)), np.asarray(S.indices, np.int64)


def _side(before: Edited, side: str) -> Floats:
    """Return how far (n,) each tet lies on a side: 0 on the other, 1 beyond the mid-plane."""
    model = before.model
    x = model.rest[model.tets].mean(axis=1)[:, 0] - model.jaw.origin[0]
    outward = x if side == "left" else -x
    t = np.clip(0.5 + 0.5 * outward / before.options.side_mm, 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))
