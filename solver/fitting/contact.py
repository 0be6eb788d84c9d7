"""Contact: fitted lips stay out of each other and in front of the teeth.

    c(x) = w/2 sum_p max(0, d_p(x) - s)^2 + w/2 sum_p h_p(x)^2

over the lips' vertices p: d_p is how deep p lies in the other lip, less than the slack s being free,
and h_p how deep behind a row of teeth, beyond what is free. Teeth are the fields that simulations
have (:mod:`solver.contact.arches`), so a lip comes out to the front from any depth. Lips have no
barrier, as they do in simulations: it allows no crossing, and scans and the ways of fits have lips
that cross. What a vertex has crossed there is found anew at every x; c is continuous where that
begins, as it begins within the slack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import rows_of
from solver.contact.arches import Arch
from solver.contact.mandible import Mandible
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mouth
from solver.contact.one_sided import Excess, along
from solver.contact.overlap import between_lips
from solver.errors import SolveError
from solver.model import SubjectModel
from solver.surface import Floats, Surface

WEIGHT = 600.0
"""A lip's vertex in contact counts like so many vertices of the face skin: its depth beyond the
slack has to be small even where a scan, by interpolation or registration, crosses itself."""
LIPS_SLACK_MM = 0.2
TEETH_SLACK_MM = 1.0
"""Free, as is what is deeper in the neutral: scans of expressions have lips in teeth by registration
or interpolation, up to 3 mm. With 0.3 instead, a fit of S comes 6 % less near to them."""


@dataclass(frozen=True)
class _Touching:
    """h vertices in contact: ``depth`` (h,) beyond what is free, and its derivative (h, 3 p)."""

    depth: Floats
    slope: sp.csr_array


class Teeth:
    """Upper and lower teeth, as far as a model has them, and how far behind them its lips are."""

    def __init__(self, model: SubjectModel, mouth: Mouth) -> None:
        lips = np.flatnonzero(mouth.label == LIPS)
        self._rows = sp.csr_array(mouth.rows[lips])
        self._offset = mouth.offset[lips]
        rest = mouth.points(model.rest)
        self._mandible = Mandible.of(model)

        def row(label: int) -> Excess | None:
            faces = mouth.faces_of(label)
            if not len(faces):
                return None
            return Excess(Arch.of(Surface(rest, faces)), rest[lips], TEETH_SLACK_MM)

        self._upper, self._lower = row(UPPER_TEETH), row(LOWER_TEETH)

    def touching(self, x: Floats) -> list[_Touching]:
        """Find the lips' vertices behind teeth at x (p, 3), for each row of teeth."""
        points = np.asarray(self._rows @ x + self._offset)
        found = []
        if self._upper is not None:
            depth, slope = self._upper.at(points)
            deep = np.flatnonzero(depth)
            found.append(_Touching(depth[deep], along(self._rows[deep], slope[deep])))
        if self._lower is not None:
            local, shares, turn = self._mandible.seen(points, x)
            depth, slope = self._lower.at(local)
            deep = np.flatnonzero(depth)
            corners = np.tile(self._mandible.corners, (len(deep), 1))
            apart = self._rows[deep] - rows_of(corners, shares[deep], len(x))
            found.append(_Touching(depth[deep], along(apart, slope[deep] @ turn)))
        return found


class Contact:
    """The term c, a :class:`solver.fitting.terms.Term`; w is :data:`WEIGHT` / k, k face vertices.

    Fits of several expressions share the ``teeth``. Its methods raise :class:`SolveError`
    (``solve.not_finite``) where x is not finite.
    """

    def __init__(self, model: SubjectModel, mouth: Mouth, teeth: Teeth) -> None:
        self._mouth = mouth
        self._teeth = teeth
        # the data's weights sum to one over the face
        self._weight = WEIGHT / len(model.face)
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
            found = [_lips(self._mouth, x), *self._teeth.touching(x)]
            depth = np.concatenate([part.depth for part in found])
            slope = sp.csr_array(sp.vstack([part.slope for part in found]))
            self._last = x.copy(), _Touching(depth, slope)
        return self._last[1]


def _lips(mouth: Mouth, x: Floats) -> _Touching:
    """Find the lips' vertices in the other lip.

    The nearest point's place in its triangle is at a minimum, so that its change does not count:
    the depth grows as that point moves out, or the vertex in.
    """
    found = between_lips(mouth, mouth.points(x))
    deep = found.where(found.depth > LIPS_SLACK_MM)
    count = len(mouth.label)
    nearest = rows_of(deep.corners, deep.shares, count)
    vertex = rows_of(deep.ids[:, None], np.ones((len(deep.ids), 1)), count)
    apart = sp.csr_array((nearest - vertex) @ mouth.rows)
    return _Touching(deep.depth - LIPS_SLACK_MM, along(apart, deep.out))
