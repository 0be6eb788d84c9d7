"""Carrying a template's anatomy into a person whose neutral scan has the template's topology."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.template import Muscle, Template
from solver.anatomy.warp import Warp, interpolate, spread
from solver.surface import Floats, Surface

CORRESPONDENCES = 900
SMOOTHING_MM = 2.0
CLEARANCE_MM = 1.9
"""Bones stay this deep under the skin where they do in the template."""
CLEARANCE_STEPS = 8


def skin_warp(template: Template, neutral: Floats) -> Warp:
    """Return the smooth map of space from the template's head to the one with skin ``neutral``.

    It goes through about :data:`CORRESPONDENCES` flesh vertices spread over the skin.
    """
    flesh = np.unique(template.skin.faces[template.flesh_faces])
    source = template.skin.vertices
    chosen = flesh[spread(source[flesh], CORRESPONDENCES)]
    return interpolate(source[chosen], neutral[chosen], SMOOTHING_MM)


def carry(template: Template, neutral: Floats, warp: Warp) -> Template:
    """Return the anatomy of the person with skin ``neutral`` (n, 3), without shapes and tets.

    ``warp`` is the person's :func:`skin_warp`. The cut planes move outwards where the face
    reaches further than the template's.
    """
    source = template.skin.vertices
    before, after = _Depths(template, source), _Depths(template, neutral)

    def bone(surface: Surface) -> Surface:
        return surface.moved(_deep_enough(surface.vertices, warp(surface.vertices), before, after))

    face = template.face_vertices
    reach = neutral[face].min(axis=0) - source[face].min(axis=0)
    return replace(
        template,
        skin=template.skin.moved(neutral),
        parting=warp(source + template.parting) - warp(source),
        cranium=bone(template.cranium),
        mandible=bone(template.mandible),
        muscles=tuple(carried_muscle(muscle, warp) for muscle in template.muscles),
        condyles=warp(template.condyles),
        back_z=template.back_z + min(0.0, float(reach[2])),
        bottom_y=template.bottom_y + min(0.0, float(reach[1])),
        shapes=None,
        mesh=None,
    )


def carried_muscle(muscle: Muscle, motion: Callable[[Floats], Floats]) -> Muscle:
    """Return a muscle whose points have all been moved by ``motion``, (n, 3) -> (n, 3)."""
    middle = (muscle.origin + muscle.insertion) / 2
    half = muscle.fibre * np.linalg.norm(muscle.insertion - muscle.origin) / 2
    points = np.stack([muscle.origin, muscle.insertion, middle - half, middle + half])
    origin, insertion, start, end = motion(points)
    return replace(
        muscle,
        surface=muscle.surface.moved(motion(muscle.surface.vertices)),
        fibre=(end - start) / np.linalg.norm(end - start),
        origin=origin,
        insertion=insertion,
    )


class _Depths:
    """How deep points lie under all skin of the flesh, and how far from the face's."""

    def __init__(self, template: Template, skin: Floats) -> None:
        flesh = template.skin.faces[template.flesh_faces]
        on_face = np.isin(flesh, template.face_vertices).all(axis=1)
        self.flesh = SkinDepth(Surface(skin, flesh))
        self.face = SkinDepth(Surface(skin, flesh), flesh[on_face])


def _deep_enough(points: Floats, moved: Floats, before: _Depths, after: _Depths) -> Floats:
    """Return ``moved`` (n, 3) pushed as deep as ``points`` (n, 3), or :data:`CLEARANCE_MM`.

    Between face and lining there may be no room for both; then the face's skin is kept clear.
    """
    for _ in range(CLEARANCE_STEPS):
        start = moved
        for skin_before, skin_after in ((before.flesh, after.flesh), (before.face, after.face)):
            least = np.minimum(skin_before(points)[0], CLEARANCE_MM)
            depths, deeper = skin_after(moved)
            # A bone that reaches through the lining of the mouth has no depth to keep.
            missing = np.where(least > 0, np.maximum(least - depths, 0.0), 0.0)
            moved = moved + missing[:, None] * deeper
        if np.array_equal(moved, start):
            break
    return moved
