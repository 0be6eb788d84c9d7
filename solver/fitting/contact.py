"""Contact: fitted lips stay out of each other and out of the teeth.

    c(x) = w/2 sum_p max(0, d_p(x) - s_d)^2 + w/2 sum_p max(0, e_p(x) - s_e)^2

over the lips' vertices p: d_p is how deep p lies in the other lip, and e_p how deep behind the
teeth's outer side, so that a lip is never pushed further into the mouth. Less than the slacks s is
free. What a vertex has crossed is found anew at every x; c is continuous where that begins, as it
begins within the slack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import rows_of
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.overlap import Overlap, Shell, behind, between_lips
from solver.errors import SolveError
from solver.model import SubjectModel
from solver.surface import Floats
from solver.triangles import area_normals

WEIGHT = 600.0
"""A lip's vertex in contact counts like so many vertices of the face skin: its depth beyond the
slack has to be small even where a scan, by interpolation or registration, crosses itself."""
LIPS_SLACK_MM = 0.2
TEETH_SLACK_MM = 1.0
"""Roots of teeth lie in the linings of many a neutral scan."""
TEETH_MM = 3.0
"""Deepest that a lip is looked for behind the teeth's outer side."""
OUTER = 0.3
"""Least cosine between a tooth's outer side and the way out of the mouth."""


@dataclass(frozen=True)
class _Touching:
    """h vertices in contact: ``depth`` (h,) beyond the slack, and its derivative (h, 3 p)."""

    depth: Floats
    slope: sp.csr_array


class Contact:
    """The term c, a :class:`solver.fitting.terms.Term`; w is :data:`WEIGHT` / k, k face vertices.

    Its methods raise :class:`SolveError` (``solve.not_finite``) where x is not finite.
    """

    def __init__(self, model: SubjectModel, mouth: Mouth) -> None:
        self._mouth = mouth
        # the data's weights sum to one over the face
        self._weight = WEIGHT / len(model.face)
        self._lips = np.flatnonzero(mouth.label == LIPS)
        self._teeth = _outer_teeth(mouth, mouth.points(model.rest))
        self._last: tuple[Floats, _Touching] | None = None

    def value(self, x: Floats) -> float:
        """See :class:`solver.fitting.terms.Term`."""
        depth = self._touching(x).depth
        return 0.5 * self._weight * float(depth @ depth)

    def gradient(self, x: Floats) -> Floats:
        """See :class:`solver.fitting.terms.Term`."""
        touching = self._touching(x)
        return self._weight * np.asarray(touching.slope.T @ touching.depth).reshape(x.shape)

    def curvature(self, x: Floats) -> sp.csr_array:
        """See :class:`solver.fitting.terms.Term`."""
        slope = self._touching(x).slope
        return sp.csr_array(self._weight * (slope.T @ slope))

    def _touching(self, x: Floats) -> _Touching:
        """Find the contacts at x; gradient and curvature ask for the same x again."""
        if not np.isfinite(x).all():
            raise SolveError("solve.not_finite", "the flesh has run away: x is not finite")
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self._find(self._mouth.points(x)))
        return self._last[1]

    def _find(self, points: Floats) -> _Touching:
        found = [(between_lips(self._mouth, points), LIPS_SLACK_MM)]
        if len(self._teeth.faces):
            found.append((behind(points, self._lips, self._teeth, TEETH_MM), TEETH_SLACK_MM))
        deep = [(overlap.where(overlap.depth > slack), slack) for overlap, slack in found]
        return _Touching(
            np.concatenate([overlap.depth - slack for overlap, slack in deep]),
            sp.csr_array(sp.vstack([self._slope(overlap) for overlap, _ in deep])),
        )

    def _slope(self, overlap: Overlap) -> sp.csr_array:
        """Return d depth/dx, (h, 3 p).

        The nearest point's place in its triangle is at a minimum, so that its change does not
        count: the depth grows as that point moves out, or the vertex in.
        """
        count = len(self._mouth.label)
        nearest = rows_of(overlap.corners, overlap.shares, count)
        vertex = rows_of(overlap.ids[:, None], np.ones((len(overlap.ids), 1)), count)
        apart = sp.coo_array((nearest - vertex) @ self._mouth.rows)
        row, column = apart.coords
        values = apart.data[:, None] * overlap.out[row]
        columns = 3 * column[:, None] + np.arange(3)
        return sp.csr_array(
            (values.ravel(), (np.repeat(row, 3), columns.ravel())),
            shape=(apart.shape[0], 3 * apart.shape[1]),
        )


def _outer_teeth(mouth: Mouth, points: Floats) -> Shell:
    """Return the side of the teeth that lips lie on: what faces away from the mouth's middle."""
    faces = np.vstack([mouth.faces_of(UPPER_TEETH), mouth.faces_of(LOWER_TEETH)])
    if not len(faces):
        return Shell(faces)
    corners = points[faces]
    normals = area_normals(points, faces)
    middle = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
    out = (corners.mean(axis=1) - middle) * [1.0, 0.0, 1.0]
    lengths = np.linalg.norm(out, axis=1) * np.linalg.norm(normals, axis=1)
    return Shell(faces[np.einsum("fi,fi->f", out, normals) > OUTER * lengths])
