"""Named parts of the skin that touch each other: teeth, lips' linings, eyeballs and lids.

Contact between them is solved elsewhere; here is only which vertices take part in it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.lip_sides import LOWER, UPPER
from solver.normals import vertex_normals
from solver.surface import Floats, Ints, Surface

LINING_MM = 6.0
"""Lips' lining lies this near to the teeth that lips cover."""
LID_MM = 4.0
"""Lids lie this near to the eyeball."""
ON_BALL_MM = 0.2
"""And no deeper in it: what goes on behind the lids, in the socket, is none of them."""
FRONT_TEETH = 0.5
"""Part of the teeth's length, from the front, that lips cover."""


def contact_regions(
    flesh: Surface, sides: Ints, parts: Mapping[str, Ints], landmarks: Mapping[str, int]
) -> dict[str, Ints]:
    """Return region -> skin vertices, sorted.

    Parameters
    ----------
    flesh
        The template's skin, all its vertices (V, 3) in mm, with only the triangles that bound the
        flesh: face, lips and linings.
    sides
        (V,) the lip that a vertex belongs to (:func:`solver.anatomy.lip_sides.lip_sides`): which
        teeth are nearer says nothing, as upper ones stand before the lower lip.
    parts
        Vertices of ``upper_teeth``, ``lower_teeth``, ``left_eyeball`` and ``right_eyeball``.
    landmarks
        Name -> vertex; has the four canthi (``endocanthion_l`` and so on).
    """
    regions = {name: np.sort(ids) for name, ids in parts.items()}
    skin, own = flesh.vertices, np.unique(flesh.faces)
    teeth = np.vstack([_front(skin[parts[f"{jaw}_teeth"]]) for jaw in ("upper", "lower")])
    lining = own[cKDTree(teeth).query(skin[own])[0] < LINING_MM]
    for lip, side in (("upper", UPPER), ("lower", LOWER)):
        regions[f"{lip}_lip_lining"] = lining[sides[lining] == side]
    for eye in ("left", "right"):
        regions |= _lids(flesh, own, parts[f"{eye}_eyeball"], landmarks, eye)
    return regions


def _front(teeth: Floats) -> Floats:
    """Return those of a row of teeth's vertices that lips cover."""
    return teeth[teeth[:, 2] > np.quantile(teeth[:, 2], 1 - FRONT_TEETH)]


def _lids(
    flesh: Surface, own: Ints, eyeball: Ints, landmarks: Mapping[str, int], side: str
) -> dict[str, Ints]:
    """Split the skin on one eyeball along the line between the corners of the eye."""
    skin, ball = flesh.vertices, flesh.vertices[eyeball]
    centre = (ball.min(axis=0) + ball.max(axis=0)) / 2
    radius = np.median(np.linalg.norm(ball - centre, axis=1))
    away = skin[own] - centre
    height = np.linalg.norm(away, axis=1) - radius
    outward = (away * vertex_normals(flesh)[own]).sum(axis=1) > 0
    own = own[outward & (height > -ON_BALL_MM) & (height < LID_MM) & (away[:, 2] > 0)]
    corners = [skin[landmarks[f"{name}_{side[0]}"]] for name in ("endocanthion", "exocanthion")]
    inner, outer = sorted(corners, key=lambda point: float(point[0]))
    line = np.interp(skin[own, 0], [inner[0], outer[0]], [inner[1], outer[1]])
    above = skin[own, 1] > line
    return {f"{side}_upper_lid": own[above], f"{side}_lower_lid": own[~above]}
