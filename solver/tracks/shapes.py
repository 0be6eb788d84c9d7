"""Shapes of a person's skin with the jaw taken out, so that they add up before it turns.

A shape as scanned or sculpted has its jaw in it, and two such shapes added shear the mandible. So
the model is skinning after shapes,

    x = (1 - o) y + o J(b) y,    y = n + sum_k w_k B_k,    b = j + sum_k w_k b_k

b_k is the rigid motion of the lower teeth in shape k, the skinning weight o is harmonic in the
flesh, 1 on the mandible and 0 on the skull, and B_k is what makes the model the shape at weight 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.anatomy.template import CORRECTED, ShapeBasis
from solver.errors import InputError
from solver.mechanics.boundary import JAW_FREEDOM, FreeJaw
from solver.mechanics.harmonic import HarmonicExtension
from solver.mechanics.jaw_tracks import nearest_jaw
from solver.model import SubjectModel
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class ShapeOptions:
    """When shapes count as nothing, and which skin stands for teeth that a model lacks."""

    least_mm: float = 0.05  # a shape that moves no skin on flesh further does nothing
    as_teeth: float = 0.9  # skinning weight of the skin that stands for them
    still_mm: float = 0.01  # teeth that move less are still: templates round


def template_shapes(model: SubjectModel, basis: ShapeBasis | None) -> dict[str, Floats]:
    """Return name -> the motion (V, 3) of a person's skin in every expression of its template.

    Correctives such as ``mouthClose`` are as they are, to be added to what they correct. Raises
    :class:`InputError` (``tracks.no_shapes``) for a template without expressions.
    """
    if basis is None or not len(basis.expression_names):
        name = model.template.get("name", "")
        message = f"the template {name} has no expressions that tracks could be built of"
        raise InputError("tracks.no_shapes", message)
    motions = basis.expressions.astype(np.float64)
    return dict(zip(basis.expression_names, motions, strict=True))


def check_shapes(model: SubjectModel, shapes: Mapping[str, Floats]) -> None:
    """Raise :class:`InputError` for shapes of no use.

    ``tracks.no_shapes`` if there are none, ``tracks.topology`` for those of another skin,
    ``tracks.shape`` for vertices that are no number.
    """
    if not shapes:
        raise InputError("tracks.no_shapes", "there are no shapes that tracks could be built of")
    expected = model.skin.vertices.shape
    for name, motion in shapes.items():
        if motion.shape != expected:
            reason = f"the shape {name} is {motion.shape}, the subject's skin {expected}"
            sizes = {"expected": list(expected), "found": list(motion.shape)}
            raise InputError("tracks.topology", reason, shape=name, **sizes)
        wrong = np.flatnonzero(~np.isfinite(motion).all(axis=1))
        if len(wrong):
            reason = f"the shape {name} is no number at {len(wrong)} vertices, first {wrong[0]}"
            raise InputError("tracks.shape", reason, shape=name, vertex=int(wrong[0]))


def skinning_weights(model: SubjectModel, laplacian: sp.csr_array) -> Floats:
    """Return o (p,): how much of the jaw's motion each vertex of the flesh goes along with.

    Harmonic, 1 on the mandible, 0 on the skull and where the model ends, free on the skin.
    """
    given = np.zeros(len(model.rest), dtype=bool)
    for held in (model.cranium, model.cut, model.sliding, model.mandible):
        given[held] = True
    values = np.zeros(len(model.rest))
    values[model.mandible] = 1.0
    return np.clip(HarmonicExtension(laplacian, given, trace=1e-9)(values), 0.0, 1.0)


def skinning_of_skin(model: SubjectModel, skinning: Floats) -> Floats:
    """Return o (e,) on the skin vertices that follow the flesh, of that in the flesh (p,)."""
    return np.asarray(np.clip(model.embedding @ skinning, 0.0, 1.0))


@dataclass(frozen=True)
class JawFreeShapes:
    """K shapes without the jaw, on the e skin vertices that follow the flesh."""

    names: tuple[str, ...]
    jaw: Floats  # (K, 5) b_k, rad and mm
    motions: Floats  # (K, e, 3) B_k, mm
    teeth_mm: Floats  # (K,) what the jaw's motion misses of the lower teeth, root mean square
    notices: tuple[str, ...]  # what somebody should know of these shapes

    @classmethod
    def of(
        cls,
        model: SubjectModel,
        shapes: Mapping[str, Floats],
        skinning: Floats,
        options: ShapeOptions = ShapeOptions(),
    ) -> JawFreeShapes:
        """Take the jaw out of ``shapes``, name -> motion (V, 3), by the skinning weights o (p,).

        Raises as :func:`check_shapes`.
        """
        check_shapes(model, shapes)
        on_skin = skinning_of_skin(model, skinning)
        teeth, notices = _teeth(model, on_skin, options)
        split = _JawSplit(model, on_skin, teeth, options.still_mm)
        numbers = []
        motions = []
        missed = []
        for name, motion in shapes.items():
            under = CORRECTED.get(name, "")
            if under in shapes:
                # a corrective is what its lips do while the jaw is open
                b, moved, left = split(shapes[under] + motion)
                below, before, _ = split(shapes[under])
                b = b - below
                moved = moved - before
            else:
                b, moved, left = split(motion)
            numbers.append(b)
            motions.append(moved)
            missed.append(left)
            if np.linalg.norm(motion[model.embedded], axis=1).max() < options.least_mm:
                notices.append(f"{name} moves no skin on flesh")
        parts = np.array(numbers), np.array(motions), np.array(missed)
        return cls(tuple(shapes), *parts, tuple(notices))


@dataclass(frozen=True)
class ShapeOnTop:
    """A shape without its jaw that counts from a sum of K others."""

    name: str
    weights: Floats  # (K,) of that sum
    jaw: Floats  # (5,) b on top of the sum's, rad and mm
    motion: Floats  # (e, 3) B, mm
    confidence: Floats  # (e,) of the motion, within 0 and 1; 0 where it is not known


@dataclass(frozen=True)
class _JawSplit:
    """Splits shapes into the jaw's motion, by the skin vertices ``teeth``, and what is left."""

    model: SubjectModel
    on_skin: Floats  # (e,) o
    teeth: Ints
    still_mm: float

    def __call__(self, motion: Floats) -> tuple[Floats, Floats, float]:
        """Return b (5,) and B (e, 3) of a ``motion`` (V, 3), and what b misses of the teeth."""
        jaw = FreeJaw(self.model.jaw)
        neutral = self.model.skin.vertices
        teeth = neutral[self.teeth]
        start = neutral[self.model.embedded]
        goal = teeth + motion[self.teeth]
        b = np.zeros(JAW_FREEDOM)
        if np.abs(motion[self.teeth]).max(initial=0.0) > self.still_mm:
            b = nearest_jaw(jaw, teeth, goal, b)
        left = np.sqrt(((jaw.move(teeth, b) - goal) ** 2).sum() / max(len(teeth), 1))
        target = start + motion[self.model.embedded]
        return b, before_skinning(target, self.on_skin, jaw.matrix(b)) - start, float(left)


def _teeth(model: SubjectModel, on_skin: Floats, options: ShapeOptions) -> tuple[Ints, list[str]]:
    """Return the skin vertices that tell how the jaw moves, and what is to be told of them."""
    teeth = model.lower_teeth
    if len(teeth) >= 3:
        return teeth, []
    chin = model.embedded[on_skin >= options.as_teeth]
    if len(chin) >= 3:
        return chin, ["the model has no lower teeth: shapes' jaws are those of the chin"]
    return chin[:0], ["the model has no lower teeth: shapes are taken as without the jaw"]


def before_skinning(target: Floats, weights: Floats, motion: Floats) -> Floats:
    """Return the y (e, 3) that skinning with ``weights`` (e,) and a jaw (4, 4) takes to targets."""
    share = weights[:, None, None]
    blended = (1.0 - share) * np.eye(3) + share * motion[:3, :3]
    moved = target - weights[:, None] * motion[:3, 3]
    return np.asarray(np.linalg.solve(blended, moved[:, :, None])[:, :, 0])
