"""Named parts of the built-in head's skin, drawn with its landmarks."""

from __future__ import annotations

import numpy as np

from solver.anatomy.builtin_depths import OuterSkin
from solver.anatomy.builtin_head import Head
from solver.anatomy.lip_sides import LOWER, UPPER
from solver.surface import Floats, Ints

BEHIND_TRAGUS_MM = 12.0
"""The face ends this far in front of the tragus: no ear, no skin behind it."""
UNDER_JAW_MM = 4.0


class Regions:
    """Splits the visible skin; every result is a sorted array of vertex numbers.

    ``sides`` (n,) tells the lips of the head apart, as :func:`lip_sides` does.
    """

    def __init__(self, head: Head, skin: OuterSkin, sides: Ints) -> None:
        self._visible = skin.visible_vertices
        self._side = sides[self._visible]
        self._x = np.abs(head.neutral[self._visible, 0])
        self._y, self._z = head.neutral[self._visible, 1], head.neutral[self._visible, 2]
        marks = head.landmarks
        self._at = {name: head.neutral[vertex] for name, vertex in marks.items()}
        self._above_jaw = self._y > self._jaw_line() - UNDER_JAW_MM
        self._front = self._z > self._at["tragus_l"][2] + BEHIND_TRAGUS_MM

    def _jaw_line(self) -> Floats:
        """Height of the lower border of the jaw at each vertex, by its z."""
        line = [self._at[name] for name in ("gonion_l", "mid_mandibular_border_l", "menton")]
        return np.asarray(
            np.interp(self._z, [point[2] for point in line], [point[1] for point in line])
        )

    def face(self) -> Ints:
        """Brow to chin and ear to ear with the forehead, without ears, scalp and neck."""
        forehead = self._y < self._at["trichion"][1] - 15
        return np.asarray(self._visible[self._front & self._above_jaw & forehead])

    def named(self) -> dict[str, Ints]:
        """Return the regions of the face, and the neck, by name; they do not overlap."""
        at, x, y = self._at, self._x, self._y
        face = np.isin(self._visible, self.face())
        mouth_corner = at["cheilion_l"]
        lips = (
            (x < mouth_corner[0] + 6)
            & (y > at["mentolabial_sulcus"][1])
            & (y < at["alar_curvature_l"][1])
        )
        tests = {
            "forehead": y > at["brow_lateral_l"][1] + 4,
            "brows": y > at["palpebrale_superius_l"][1] + 5,
            "nose": (x < at["alare_l"][0] + 1.5)
            & (y > at["subnasale"][1] + 1)
            & (x < 10 + 0.25 * (at["nasion"][1] - y)),
            "eyes": (y > at["mid_infraorbital_l"][1]) & (x < at["lateral_orbit_l"][0] + 4),
            "upper_lip": lips & (self._side == UPPER),
            "lower_lip": lips & (self._side == LOWER),
            "chin": (x < mouth_corner[0]) & (y < at["mentolabial_sulcus"][1] + 1),
            "jaw": y < mouth_corner[1],
            "cheeks": y < at["brow_lateral_l"][1] + 8,
        }
        regions: dict[str, Ints] = {}
        free = face
        for name, test in tests.items():
            regions[name] = self._visible[free & test]
            free = free & ~test
        regions["neck"] = self._visible[~self._above_jaw & (y < at["gonion_l"][1] + 10)]
        return regions
