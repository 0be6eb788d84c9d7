"""Lids that shut where muscles leave a gap, and go over the eyeball on their way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.action_units import SIDES
from solver.anatomy.template import ShapeBasis
from solver.animation import RecordedDrives
from solver.contact.obstacles import Eyeball
from solver.contact.one_sided import free_depths
from solver.model import SubjectModel
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class LidOptions:
    """How lids are finished where muscles do not bring them to their template's shape."""

    # so far beyond the lids a shape is the flesh's again: lids shut by less than half of this
    fade_mm: float = 10.0
    margin_mm: float = 0.1  # kept between lid and eyeball, or what there is at rest
    steps: int = 20  # of a shape's way that are looked at
    least_mm: float = 0.02  # lids that come less far into the eyeball need no corrective


@dataclass(frozen=True, eq=False)
class Lids:
    """The lids of one eye: its ``side``, ``vertices`` (k,) and a ``share`` (V,) of the whole skin.

    A lid may lie ``free`` (k,) deep in its eyeball, mm: as at rest.
    """

    side: str
    vertices: Ints
    share: Floats
    eyeball: Eyeball
    free: Floats
    options: LidOptions = LidOptions()

    @classmethod
    def of(cls, model: SubjectModel, options: LidOptions = LidOptions()) -> list[Lids]:
        """Return the lids of both eyes, as far as a model names them and their eyeballs."""
        skin = model.skin.vertices
        balls = [model.region(f"{side}_eyeball") for side in SIDES]
        found = []
        for side, ball in zip(SIDES, balls, strict=True):
            parts = [model.region(f"{side}_{lid}_lid") for lid in ("upper", "lower")]
            vertices = np.concatenate(parts)
            if not (len(vertices) and len(ball)):
                continue
            distance, _ = cKDTree(skin[vertices]).query(skin)
            near = np.clip(1.0 - distance / options.fade_mm, 0.0, 1.0)
            share = near**2 * (3.0 - 2.0 * near)
            share[np.concatenate(balls)] = 0.0
            eyeball = Eyeball.of(skin[ball])
            free = free_depths(eyeball, skin[vertices], -options.margin_mm)
            found.append(cls(side, vertices, share, eyeball, free, options))
        return found

    def moves(self, name: str) -> bool:
        """Tell whether a shape of ARKit is one of this eye."""
        return name.startswith("eye") and name.endswith(self.side.capitalize())

    def depth(self, skin: Floats) -> Floats:
        """Return how far (k,) the lids of a skin (V, 3) are in the eyeball beyond what is free."""
        return np.asarray(self.eyeball.depths(skin[self.vertices])[0] - self.free)

    def finish(self, skin: Floats, wanted: Floats, amount: float = 1.0) -> Floats:
        """Return a skin (V, 3) with the lids of the template's shape, ``wanted``, off the eyeball.

        It is the flesh's beyond ``fade_mm``. An ``amount`` below 1 goes that part of the way.
        """
        finished = skin + amount * self.share[:, None] * (wanted - skin)
        return finished + self._out(finished, amount * np.maximum(self.depth(finished), 0.0))

    def half_way(self, skin_at: Callable[[float], Floats]) -> Floats | None:
        """Return the motion (V, 3) that, times 4 w (1 - w), keeps lids off the eyeball on the way.

        ``skin_at`` is the skin for a weight w. None: they do not come into it.
        """
        needed = np.zeros(len(self.vertices))
        outward = self._outward(skin_at(0.5))
        for weight in np.linspace(0.0, 1.0, self.options.steps + 1)[1:-1]:
            skin = skin_at(weight)
            along = np.sum(self._outward(skin) * outward, axis=1)
            pushed = self.depth(skin) / (4.0 * weight * (1.0 - weight) * along)
            needed = np.maximum(needed, pushed)
        if needed.max() <= self.options.least_mm:
            return None
        return self._out(skin_at(0.5), needed)

    def _out(self, skin: Floats, depth: Floats) -> Floats:
        """Return the motion (V, 3) of lids by ``depth`` (k,) out of the eyeball."""
        motion = np.zeros_like(skin)
        motion[self.vertices] = depth[:, None] * self._outward(skin)
        return motion

    def _outward(self, skin: Floats) -> Floats:
        """Return the unit vectors (k, 3) from the eyeball's centre to the lids."""
        arm = skin[self.vertices] - self.eyeball.centre
        return np.asarray(arm / np.linalg.norm(arm, axis=1, keepdims=True))


class PlayedLids:
    """Lids of a recording's frames, led to where its shapes take them as far as those move an eye.

    Muscles alone close ``lids`` by two thirds. ``basis`` are the template's shapes, of which the
    ``drives`` play some.
    """

    def __init__(self, lids: Sequence[Lids], basis: ShapeBasis, drives: RecordedDrives) -> None:
        self._drives = drives
        self._lids = lids
        names = drives.names
        self._of_eye = [[k for k, n in enumerate(names) if each.moves(n)] for each in lids]
        self._near = np.flatnonzero(np.sum([each.share for each in lids], axis=0))
        self._motions = np.zeros((len(drives.names), len(self._near), 3))
        for number, name in enumerate(drives.names):
            if name in basis.expression_names:  # all but a person's own
                shape = basis.expressions[basis.expression_names.index(name)]
                self._motions[number] = shape[self._near]

    def lead(self, skin: Floats, neutral: Floats, time: float) -> Floats:
        """Return a ``skin`` (V, 3) at ``time`` with its lids led; both are in the head's frame."""
        weights = self._drives.weights_at(time)
        wanted = skin.copy()
        wanted[self._near] = neutral[self._near] + np.tensordot(weights, self._motions, 1)
        for lids, of_eye in zip(self._lids, self._of_eye, strict=True):
            amount = float(np.clip(weights[of_eye].sum(), 0.0, 1.0))
            skin = lids.finish(skin, wanted, amount)
        return skin
