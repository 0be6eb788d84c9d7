"""Bones moved by handles: a chin brought forward, a cheek bone set back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import igl
import numpy as np

from solver.anatomy.embedding import LooseSkin
from solver.edits.edit import Edited
from solver.errors import InputError
from solver.model import SubjectModel
from solver.surface import Floats, Ints, Surface

STEEPEST = 8.0 / (3.0 * np.sqrt(3.0))  # the greatest slope of (1 - t^2)^2


@dataclass(frozen=True)
class Bone:
    """The part of a ``bone`` around a handle moves by ``move_mm`` (3,), less and less outwards.

    ``at`` (3,) is a point on the bone or on the skin before it: the handle is the bone's nearest
    point. At a distance d of it the motion is (1 - d^2 / ``radius_mm``^2)^2 ``move_mm``, for the
    bone, the flesh on it and the teeth in it; eyeballs stay. Positions are those at rest, the jaw
    closed.
    """

    bone: Literal["cranium", "mandible"]
    at: Floats
    radius_mm: float
    move_mm: Floats

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.bone``."""
        model = before.model
        if self.bone not in model.bones:
            raise InputError("scene.bone", f"the subject has no bone {self.bone!r}")
        steepness = STEEPEST * np.linalg.norm(self.move_mm) / max(self.radius_mm, 1e-9)
        if not steepness < 1.0:
            least = STEEPEST * float(np.linalg.norm(self.move_mm))
            raise InputError(
                "scene.bone",
                f"a motion of {np.linalg.norm(self.move_mm):.1f} mm within {self.radius_mm} mm "
                f"folds the bone; the radius must be above {least:.1f} mm",
                expected_mm=round(least, 1),
            )
        surface = model.bones[self.bone]
        handle = self._handle(surface, before.options.handle_mm)

        def motion(points: Floats) -> Floats:
            away = np.linalg.norm(points - handle, axis=1)
            share = np.maximum(1.0 - (away / self.radius_mm) ** 2, 0.0) ** 2
            return np.asarray(share[:, None] * self.move_mm)

        of_bone, of_skin = _vertices(model, self.bone)
        bones, skin = before.bones.copy(), model.skin.vertices.copy()
        bones[of_bone] += motion(model.rest[of_bone] + bones[of_bone])
        skin[of_skin] += motion(skin[of_skin])
        moved = surface.moved(surface.vertices + motion(surface.vertices))
        anatomy = replace(
            model, bones={**model.bones, self.bone: moved}, skin=model.skin.moved(skin)
        )
        return replace(before, model=anatomy, bones=bones)

    def _handle(self, surface: Surface, near_mm: float) -> Floats:
        """Return the bone's point (3,) nearest to ``at``."""
        at = np.ascontiguousarray(self.at, dtype=np.float64)[None]
        squared, _, nearest = igl.point_mesh_squared_distance(at, surface.vertices, surface.faces)
        away = float(np.sqrt(squared[0]))
        if away > near_mm:
            raise InputError(
                "scene.bone",
                f"the handle lies {away:.0f} mm off the {self.bone}, {near_mm:.0f} at most can be",
                found_mm=round(away, 1),
                expected_mm=near_mm,
            )
        return np.asarray(nearest[0])


def _vertices(model: SubjectModel, bone: str) -> tuple[Ints, Ints]:
    """Return the flesh's vertices on a bone, and the skin's that stay with it."""
    if bone == "mandible":
        return model.mandible, model.attached_mandible
    none = np.empty(0, np.int64)
    eyes = [model.regions.get(f"{side}_eyeball", none) for side in ("left", "right")]
    # skin beyond the flesh follows the flesh that the bone moves
    follows = [model.embedded, LooseSkin(model).ids]
    others = np.concatenate([*follows, model.attached_mandible, *eyes])
    with_cranium = np.setdiff1d(np.arange(len(model.skin.vertices)), others)
    return np.concatenate([model.cranium, model.sliding]), with_cranium
