"""Carrying a template's anatomy into a person whose neutral scan has the template's topology."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.template import Muscle, Template
from solver.anatomy.warp import interpolate, spread
from solver.surface import Floats, Surface

CORRESPONDENCES = 900
SMOOTHING_MM = 2.0
CLEARANCE_MM = 1.8
"""Bones stay this deep under the skin where they do in the template."""
CLEARANCE_STEPS = 8


@dataclass(frozen=True)
class Carried:
    """The template's anatomy in the person; see :class:`Template` for the fields."""

    skin: Surface
    parted: Surface
    cranium: Surface
    mandible: Surface
    muscles: tuple[Muscle, ...]
    condyles: Floats


def carry(template: Template, neutral: Floats) -> Carried:
    """Return bones, muscles, condyles and parted skin of the person with skin ``neutral`` (n, 3).

    The warp goes through about :data:`CORRESPONDENCES` flesh vertices spread over the skin.
    """
    flesh = np.unique(template.skin.faces[template.flesh_faces])
    source = template.skin.vertices
    chosen = flesh[spread(source[flesh], CORRESPONDENCES)]
    warp = interpolate(source[chosen], neutral[chosen], SMOOTHING_MM)
    parting = warp(source + template.parting) - warp(source)
    skin = template.skin.moved(neutral)
    before = SkinDepth(Surface(source, template.skin.faces[template.flesh_faces]))
    after = SkinDepth(Surface(neutral, skin.faces[template.flesh_faces]))

    def bone(surface: Surface) -> Surface:
        least = np.minimum(before(surface.vertices)[0], CLEARANCE_MM)
        return surface.moved(_deep_enough(warp(surface.vertices), least, after))

    def carried(muscle: Muscle) -> Muscle:
        origin, insertion = warp(np.stack([muscle.origin, muscle.insertion]))
        axis = insertion - origin
        return Muscle(
            muscle.name,
            muscle.surface.moved(warp(muscle.surface.vertices)),
            axis / np.linalg.norm(axis),
            origin,
            insertion,
        )

    return Carried(
        skin=skin,
        parted=skin.moved(neutral + parting),
        cranium=bone(template.cranium),
        mandible=bone(template.mandible),
        muscles=tuple(carried(muscle) for muscle in template.muscles),
        condyles=warp(template.condyles),
    )


def _deep_enough(points: Floats, least: Floats, depth: SkinDepth) -> Floats:
    # A bone that reaches through the lining of the mouth has no depth to keep.
    kept = least > 0
    for _ in range(CLEARANCE_STEPS):
        depths, deeper = depth(points)
        missing = np.where(kept, np.maximum(least - depths, 0.0), 0.0)
        if not missing.any():
            break
        points = points + missing[:, None] * deeper
    return points
