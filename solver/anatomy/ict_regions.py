"""Landmarks and named regions of the ICT-FaceKit face."""

from __future__ import annotations

import numpy as np

from solver.anatomy import ict_facekit
from solver.anatomy.lip_sides import LOWER, UPPER
from solver.surface import Floats, Ints

# Vertices of the published 68 facial landmarks that bound the regions.
LANDMARKS = {
    "brow_medial_l": 3615,
    "brow_lateral_l": 2509,
    "sellion": 978,
    "nose_tip": 4857,
    "subnasale": 1147,
    "alar_curvature_l": 3360,
    "exocanthion_l": 3721,
    "endocanthion_l": 3742,
    "cheilion_l": 6213,
    "stomion_superius": 5533,
    "stomion_inferius": 5517,
    "labrale_superius": 0,
    "labrale_inferius": 5518,
    "mentolabial_sulcus": 10,
    "pogonion": 968,
}


def named_regions(skin: Floats, sides: Ints) -> dict[str, Ints]:
    """Return region -> narrow-face vertices; the regions do not overlap and leave none out.

    ``sides`` (n,) tells the lips of the ``skin`` (n, 3) apart, as :func:`lip_sides` does.
    """
    at = {name: skin[vertex] for name, vertex in LANDMARKS.items()}
    face = np.array(ict_facekit.NARROW_FACE)
    x, y = np.abs(skin[face, 0]), skin[face, 1]
    mouth_width = at["cheilion_l"][0] + 5
    mouth_y = at["stomion_superius"][1] - 0.4
    chin_y = at["mentolabial_sulcus"][1]
    lips = (x < mouth_width) & (y < at["subnasale"][1] + 2) & (y > chin_y)
    nose_width = at["alar_curvature_l"][0] + 5
    eye_y, eye_x = at["exocanthion_l"][1], at["exocanthion_l"][0]
    brow_y = at["brow_lateral_l"][1]
    tests = {
        "forehead": y > brow_y + 14,
        "brows": y > brow_y - 4,
        "nose": (x < nose_width)
        & (y > at["subnasale"][1] - 1)
        & (x < 7 + 0.3 * (at["sellion"][1] + 8 - y)),
        "eyes": (y > eye_y - 20) & (x < eye_x + 8),
        "upper_lip": lips & (sides[face] == UPPER),
        "lower_lip": lips & (sides[face] == LOWER),
        "chin": (x < mouth_width) & (y <= chin_y),
        "jaw": y < mouth_y,
        "cheeks": np.ones(len(face), dtype=bool),
    }
    regions: dict[str, Ints] = {}
    free = np.ones(len(face), dtype=bool)
    for name, test in tests.items():
        regions[name] = face[free & test]
        free &= ~test
    return regions
