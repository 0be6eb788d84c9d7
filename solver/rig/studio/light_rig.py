"""The light rig: shapes that add up, led on their way where that is an arc, and joints that turn.

    y = n + sum_k w_k d_k + sum_k 4 w_k (1 - w_k) h_k,    x = skinning(y; sum_k w_k t_k)

w are the shapes' weights, h_k what is added half way into a shape, and t_k the twists of the
joints, zero where shapes hold all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np

from solver.anatomy.template import CORRECTED
from solver.animation.lids import Lids
from solver.model import SubjectModel
from solver.rig.studio.shapes import StudioShapes
from solver.rig.studio.skeleton import Skeleton
from solver.surface import Floats, Surface, vertex_normals

DrivenBy = Literal["shapes", "joints"]
STILL_MM = 0.2  # a joint that moves skin less, in a shape, stays still: the shape has it
JOINT_UNITS = np.repeat([100.0, 1.0], 3)  # mm of a radian's turn at a chin's distance, and of a mm


@dataclass(frozen=True, eq=False)
class HalfWay:
    """A ``motion`` (V, 3), mm, that is added half way into the shape it is ``of``."""

    of: str
    motion: Floats

    @property
    def name(self) -> str:
        """The name of its morph target."""
        return f"{self.of}_half"

    def weight(self, weights: Mapping[str, float]) -> float:
        """Return v = 4 w (1 - w) for the shapes' weights."""
        own = weights.get(self.of, 0.0)
        return 4.0 * own * (1.0 - own)


@dataclass(frozen=True, eq=False)
class LightRig:
    """A skin with s shapes and j joints; lengths in mm."""

    neutral: Surface
    names: tuple[str, ...]
    motions: Floats  # (s, V, 3) d_k
    twists: Floats  # (s, j, 6) t_k
    skeleton: Skeleton
    half_ways: tuple[HalfWay, ...] = ()

    @cached_property
    def targets(self) -> dict[str, Floats]:
        """The motion (V, 3) of each morph target: the shapes, and then the half ways."""
        shapes = dict(zip(self.names, self.motions, strict=True))
        return shapes | {each.name: each.motion for each in self.half_ways}

    @cached_property
    def normals(self) -> Floats:
        """The neutral's normals (V, 3)."""
        return vertex_normals(self.neutral)

    @cached_property
    def turned(self) -> dict[str, Floats]:
        """The change of the normals (V, 3) in each morph target."""
        neutral = self.neutral
        return {
            name: vertex_normals(neutral.with_vertices(neutral.vertices + motion)) - self.normals
            for name, motion in self.targets.items()
        }

    @classmethod
    def of(cls, model: SubjectModel, shapes: StudioShapes, driven_by: DrivenBy) -> LightRig:
        """Return a person's shapes as a rig whose jaw and eyes ``driven_by`` shapes or joints move.

        Where joints do, shapes are what is left before these move the skin.
        """
        skeleton = Skeleton.of(model)
        neutral = model.skin
        twists = np.zeros((len(shapes.names), len(skeleton.joints), 6))
        rig = cls(neutral, shapes.names, shapes.motions, twists, skeleton)
        if driven_by == "shapes":
            return rig
        twists[:] = [
            skeleton.twists(model, jaw, eyes)
            for jaw, eyes in zip(shapes.jaw, shapes.eyes, strict=True)
        ]
        hardly = np.linalg.norm(twists * JOINT_UNITS, axis=2, keepdims=True) < STILL_MM
        twists[np.broadcast_to(hardly, twists.shape)] = 0.0

        def before(rows: list[int]) -> Floats:
            """Return what is left of the shapes of some rows together."""
            moved = neutral.vertices + shapes.motions[rows].sum(axis=0)
            turned = skeleton.motions(twists[rows].sum(axis=0))
            return skeleton.before(moved, turned) - neutral.vertices

        motions = np.empty_like(shapes.motions)
        for row, name in enumerate(shapes.names):
            under = [
                shapes.number[each] for each in [CORRECTED.get(name, "")] if each in shapes.number
            ]
            motions[row] = before([*under, row]) - (before(under) if under else 0.0)
        return replace(rig, motions=motions)

    def with_lids(self, lids: Sequence[Lids]) -> LightRig:
        """Return the rig with what keeps ``lids`` off their eyeballs half way into each shape."""
        found = []
        for each in lids:
            for name in filter(each.moves, self.names):
                motion = each.half_way(partial(self._alone, name))
                if motion is not None:
                    found.append(HalfWay(name, motion))
        return replace(self, half_ways=(*self.half_ways, *found))

    def _alone(self, name: str, weight: float) -> Floats:
        return self.play({name: weight})

    def play(self, weights: Mapping[str, float]) -> Floats:
        """Return the skin (V, 3) for weights by the shapes' names, the head at rest."""
        return self.skeleton.skin(self._added(weights), self._turned(weights))

    def _added(self, weights: Mapping[str, float]) -> Floats:
        """Return y (V, 3), before joints move the skin."""
        points = self.neutral.vertices + np.tensordot(self._values(weights), self.motions, 1)
        for each in self.half_ways:
            points += each.weight(weights) * each.motion
        return points

    def _turned(self, weights: Mapping[str, float]) -> Floats:
        """Return the joints' motions (j, 4, 4)."""
        return self.skeleton.motions(np.tensordot(self._values(weights), self.twists, 1))

    def _values(self, weights: Mapping[str, float]) -> Floats:
        return np.array([weights.get(name, 0.0) for name in self.names])
