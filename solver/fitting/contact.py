"""Contact: fitted lips stay out of each other and in front of the teeth.

    c(x) = w_d/2 sum_p max(0, d_p(x) - s)^2 + w_h/2 sum_p h_p(x)^2

over the lips' vertices p: d_p is how deep p lies in the other lip, less than the slack s being
free, and h_p how deep behind a row of teeth, beyond what is free. Teeth are the fields that
simulations have (:mod:`solver.contact.obstacles`), so a lip comes out to the front from any depth.
The barrier that simulations have between lips allows no crossing, but lips of scans do cross. What
a vertex has crossed is found anew at every x; c is continuous, as that begins within the slack.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.anatomy.embedding import rows_of
from solver.contact.crossing import NearLips, Overlap, between_lips
from solver.contact.mouth import LIPS, LOWER_TEETH, UPPER_TEETH, Mandible, Mouth
from solver.contact.obstacles import Arch
from solver.contact.one_sided import Excess, along, free_depths
from solver.errors import SolveError
from solver.fitting.face import Face
from solver.fitting.objective import Curvature, GramCurvature, SumTerm, Target, Term, distances
from solver.model import SubjectModel
from solver.surface import Floats, Surface


@dataclass(frozen=True)
class LipContactOptions:
    """Weights of a lip's vertex in contact, in vertices of the face skin, and what is free.

    The weights make depths beyond the slack small even where a scan, by interpolation or
    registration, crosses itself. Teeth count less: such scans have lips some millimetres in them.
    """

    lips_weight: float = 600.0  # w_d k
    teeth_weight: float = 150.0  # w_h k
    lips_slack_mm: float = 0.2
    # free, as is what is deeper in the neutral: with 0.3 a fit of S came 6 % less near to scans
    # that lie 2.4 mm deep
    teeth_slack_mm: float = 1.0


@dataclass(frozen=True)
class _Touching:
    """h vertices in contact."""

    depth: Floats  # (h,) that is not free
    slope: sp.csr_array  # (h, 3 p), its derivative
    weight: Floats  # (h,)


class Teeth:
    """Upper and lower teeth, as far as a model has them, and how far behind them its lips are."""

    def __init__(
        self, model: SubjectModel, mouth: Mouth, options: LipContactOptions = LipContactOptions()
    ) -> None:
        self._weight = options.teeth_weight
        self._mandible = Mandible.of(model)
        lips = np.flatnonzero(mouth.label == LIPS)
        rest = mouth.points(model.rest)
        self._rows = sp.csr_array(mouth.rows[lips])
        self._offset = mouth.offset[lips]

        def row(label: int) -> Excess | None:
            faces = mouth.faces_of(label)
            if not len(faces):
                return None
            arch = Arch.of(Surface(rest, faces))
            return Excess(arch, free_depths(arch, rest[lips], options.teeth_slack_mm))

        self._upper = row(UPPER_TEETH)
        self._lower = row(LOWER_TEETH)

    def touching(self, x: Floats) -> list[_Touching]:
        """Find the lips' vertices behind teeth at x (p, 3), for each row of teeth."""
        points = np.asarray(self._rows @ x + self._offset)
        found = []
        if self._upper is not None:
            found.append(self._deep(*self._upper.at(points), self._rows))
        if self._lower is not None:
            local, shares, turn = self._mandible.seen(points, x)
            depth, slope = self._lower.at(local)
            corners = np.tile(self._mandible.corners, (len(points), 1))
            apart = self._rows - rows_of(corners, shares, len(x))
            found.append(self._deep(depth, slope @ turn, apart))
        return found

    def _deep(self, depth: Floats, slope: Floats, rows: sp.csr_array) -> _Touching:
        """Return what is deep among points that move with ``rows @ x``."""
        deep = np.flatnonzero(depth)
        by_x = along(sp.csr_array(rows[deep]), slope[deep])
        return _Touching(depth[deep], by_x, np.full(len(deep), self._weight))


class _Penalty(Term):
    """w/2 of squared depths, a :class:`solver.fitting.objective.Term`.

    Its methods raise :class:`SolveError` (``solve.not_finite``) where x is not finite.
    """

    def __init__(self) -> None:
        self._last: tuple[Floats, _Touching] | None = None

    @override
    def value(self, x: Floats) -> float:
        touching = self.touching(x)
        return 0.5 * float(touching.weight @ touching.depth**2)

    @override
    def gradient(self, x: Floats) -> Floats:
        touching = self.touching(x)
        push = touching.weight * touching.depth
        return np.asarray(touching.slope.T @ push).reshape(x.shape)

    @override
    def curvature(self, x: Floats) -> Curvature:
        touching = self.touching(x)
        weights = sp.diags_array(touching.weight)
        return sp.csr_array(touching.slope.T @ (weights @ touching.slope))

    def touching(self, x: Floats) -> _Touching:
        """Find the contacts at x; gradient and curvature ask for the same x again."""
        if not np.isfinite(x).all():
            raise SolveError("solve.not_finite", "the flesh has run away: x is not finite")
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x.copy(), self._find(x)
        return self._last[1]

    def _find(self, x: Floats) -> _Touching:
        raise NotImplementedError


class Contact(_Penalty):
    """The term c.

    w_d and w_h are the weights of :class:`LipContactOptions` over the number of face vertices. Fits
    of several expressions share the ``teeth``.
    """

    def __init__(
        self,
        model: SubjectModel,
        mouth: Mouth,
        teeth: Teeth,
        options: LipContactOptions = LipContactOptions(),
    ) -> None:
        super().__init__()
        self._options = options
        self._mouth = mouth
        self._teeth = teeth
        self._scale = 1.0 / len(model.face)

    def _find(self, x: Floats) -> _Touching:
        options = self._options
        mouth = self._mouth
        overlap = between_lips(mouth, mouth.points(x))
        lips = _lips(mouth, overlap, options.lips_slack_mm, options.lips_weight)
        found = [lips, *self._teeth.touching(x)]
        return _Touching(
            np.concatenate([part.depth for part in found]),
            sp.csr_array(sp.vstack([part.slope for part in found])),
            self._scale * np.concatenate([part.weight for part in found]),
        )


class NearContact(_Penalty):
    """The lips' part of c by :class:`NearLips`, cheap enough for every frame of a take.

    Unlike c it jumps where another vertex becomes the nearest, and its gradient leaves the turning
    of the tangent planes out. ``weight`` is that of a vertex that is looked at, ``slack_mm`` is
    free.
    """

    def __init__(self, model: SubjectModel, mouth: Mouth, weight: float, slack_mm: float) -> None:
        super().__init__()
        self._mouth = mouth
        self._weight = weight
        self._slack = slack_mm
        self._lips = NearLips(mouth, mouth.points(model.rest))

    @override
    def curvature(self, x: Floats) -> GramCurvature:
        touching = self.touching(x)
        return GramCurvature(touching.slope, np.diag(touching.weight))

    def _find(self, x: Floats) -> _Touching:
        overlap = self._lips.overlap(self._mouth.points(x))
        return _lips(self._mouth, overlap, self._slack, self._weight)


def _lips(mouth: Mouth, overlap: Overlap, slack: float, weight: float) -> _Touching:
    """Return the lips' vertices that are deeper than the slack in the other lip."""
    deep = overlap.where(overlap.depth > slack)
    count = len(mouth.label)
    if not len(deep.ids):  # as in most poses
        none = np.empty(0)
        return _Touching(none, sp.csr_array((0, 3 * mouth.rows.shape[1])), none)
    # the nearest point's place in its triangle is at a minimum: its change does not count
    nearest = rows_of(deep.corners, deep.shares, count)
    vertex = rows_of(deep.ids[:, None], np.ones((len(deep.ids), 1)), count)
    apart = sp.csr_array((nearest - vertex) @ mouth.rows)
    weights = np.full(len(deep.ids), weight)
    return _Touching(deep.depth - slack, along(apart, deep.out), weights)


def terms(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the terms of every expression: the distance, and contact if the model has lips."""
    mouth = Mouth.of(face.model)
    data = distances(face, targets)
    if mouth is None:
        return data
    teeth = Teeth(face.model, mouth)
    return {name: SumTerm((term, Contact(face.model, mouth, teeth))) for name, term in data.items()}
