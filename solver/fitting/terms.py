"""Parts of a fit's objective that depend on the tets' vertices x alone.

A term gives its value, its gradient by x and the Gauss-Newton part of its Hessian; fits combine
them with the equilibrium's derivatives and know nothing else of scans, contact or markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.fitting.objective import Target
from solver.surface import Floats


class Term(Protocol):
    """A part of f; x is (p, 3) in mm, held vertices included.

    What rides on the mandible is an affine combination of its vertices, so no term needs b.
    """

    def value(self, x: Floats) -> float:
        """Return the term in mm^2."""

    def gradient(self, x: Floats) -> Floats:
        """Return its derivative by x, (p, 3)."""

    def curvature(self, x: Floats) -> sp.csr_array:
        """Return the positive semi-definite Gauss-Newton Hessian by x, (3 p, 3 p)."""


class SkinDistance:
    """sum_v w_v |(M x)_v - t_v|^2, or sum_v w_v (n_v . ((M x)_v - t_v))^2: the published terms.

    The second, point to plane, where the :class:`Target` has normals.
    """

    def __init__(self, face: Face, target: Target) -> None:
        self.target = target
        self._face = face

    def value(self, x: Floats) -> float:
        """See :class:`Term`."""
        return self.target.value(self._face.face_points(x))

    def gradient(self, x: Floats) -> Floats:
        """See :class:`Term`."""
        by_point = self.target.gradient(self._face.face_points(x))
        return np.asarray(self._face.face_embedding.T @ by_point)

    def curvature(self, x: Floats) -> sp.csr_array:  # noqa: ARG002 - it is the same everywhere
        """See :class:`Term`."""
        return self._curvature

    @cached_property
    def _curvature(self) -> sp.csr_array:
        M = self._face.face_embedding
        weights, normals = self.target.weights, self.target.normals
        if normals is None:
            by_vertex = 2.0 * M.T @ sp.diags_array(weights) @ M
            return sp.csr_array(sp.kron(by_vertex, sp.eye_array(3), format="csr"))
        points = len(weights)
        rows = np.repeat(np.arange(points), 3)
        along = sp.csr_array(
            ((normals * np.sqrt(2.0 * weights)[:, None]).ravel(), (rows, np.arange(3 * points))),
            shape=(points, 3 * points),
        )
        root = sp.csr_array(along @ sp.kron(M, sp.eye_array(3), format="csr"))
        return sp.csr_array(root.T @ root)


@dataclass(frozen=True)
class Together:
    """The sum of terms."""

    terms: tuple[Term, ...]

    def value(self, x: Floats) -> float:
        """See :class:`Term`."""
        return sum(term.value(x) for term in self.terms)

    def gradient(self, x: Floats) -> Floats:
        """See :class:`Term`."""
        return np.asarray(sum(term.gradient(x) for term in self.terms))

    def curvature(self, x: Floats) -> sp.csr_array:
        """See :class:`Term`."""
        first, *others = (term.curvature(x) for term in self.terms)
        for other in others:
            first = first + other
        return first
