"""Named parts of the skin that touch each other: teeth, lips' linings, eyeballs and lids.

Contact between them is solved elsewhere; here is only which vertices take part in it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from solver.surface import Floats, Ints

LINING_MM = 6.0
"""Lips' lining lies this near to the teeth of its jaw."""
LID_MM = 4.0
"""Lids lie this near to the eyeball."""
FRONT_TEETH = 0.5
"""Part of the teeth's length, from the front, that lips cover."""


def contact_regions(
    skin: Floats, flesh: Ints, parts: Mapping[str, Ints], landmarks: Mapping[str, int]
) -> dict[str, Ints]:
    """Return region -> skin vertices, sorted.

    Parameters
    ----------
    skin
        The template's skin (n, 3) in mm.
    flesh
        Its vertices that bound the flesh: face, lips and linings.
    parts
        Vertices of ``upper_teeth``, ``lower_teeth``, ``left_eyeball`` and ``right_eyeball``.
    landmarks
        Name -> vertex; has the four canthi (``endocanthion_l`` and so on).
    """
    regions = {name: np.sort(ids) for name, ids in parts.items()}
    distances = []
    for jaw in ("upper", "lower"):
        teeth = skin[parts[f"{jaw}_teeth"]]
        depth = np.quantile(teeth[:, 2], 1 - FRONT_TEETH)
        distances.append(cKDTree(teeth[teeth[:, 2] > depth]).query(skin[flesh])[0])
    near_upper = distances[0] < distances[1]
    for jaw, nearer, distance in zip(
        ("upper", "lower"), (near_upper, ~near_upper), distances, strict=True
    ):
        regions[f"{jaw}_lip_lining"] = np.sort(flesh[nearer & (distance < LINING_MM)])
    for side in ("left", "right"):
        regions |= _lids(skin, flesh, parts[f"{side}_eyeball"], landmarks, side)
    return regions


def _lids(
    skin: Floats, flesh: Ints, eyeball: Ints, landmarks: Mapping[str, int], side: str
) -> dict[str, Ints]:
    """Split the skin on one eyeball along the line between the corners of the eye."""
    ball = skin[eyeball]
    centre = (ball.min(axis=0) + ball.max(axis=0)) / 2
    radius = np.median(np.linalg.norm(ball - centre, axis=1))
    near = np.linalg.norm(skin[flesh] - centre, axis=1) < radius + LID_MM
    own = flesh[near & (skin[flesh, 2] > centre[2])]
    corners = [skin[landmarks[f"{name}_{side[0]}"]] for name in ("endocanthion", "exocanthion")]
    inner, outer = sorted(corners, key=lambda point: float(point[0]))
    line = np.interp(skin[own, 0], [inner[0], outer[0]], [inner[1], outer[1]])
    above = skin[own, 1] > line
    return {
        f"{side}_upper_lid": np.sort(own[above]),
        f"{side}_lower_lid": np.sort(own[~above]),
    }
