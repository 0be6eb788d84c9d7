"""Parts of a head that are meshes of their own: skin, each eye, teeth, mouth and lashes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.drawing.head import skin_parts
from solver.rig.studio.eyes import eye_places
from solver.rig.studio.skeleton import EYES, Skeleton
from solver.surface import Floats, Ints, Surface, own_numbers

TEXTURED = "skin"  # the part that a person's images lie on


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh of its own: the head's ``vertices`` (k,) that it has, and its triangles (f, 3)."""

    name: str
    material: str
    vertices: Ints  # one at a seam of the texture is there once for each of its places
    faces: Ints
    places: Floats | None = None  # (k, 2) in its images, from their lower left corner

    def moving(self, targets: Mapping[str, Floats], still_mm: float) -> list[str]:
        """Return the names of the ``targets`` (V, 3) that move it further than ``still_mm``."""
        return [
            name
            for name, motion in targets.items()
            if np.abs(motion[self.vertices]).max() > still_mm
        ]


def parts_of(
    skin: Surface, skeleton: Skeleton, texture: TextureCoordinates | None = None
) -> list[Part]:
    """Return the parts of a head; eyes with a joint each are two, with places in an eye's image.

    With ``texture``, the skin has places in its images.
    """
    found = []
    for material, numbers in skin_parts(skin).items():
        pieces = {material: numbers}
        if material == "eyes" and set(EYES) <= set(skeleton.joints):
            side = skeleton.weights[skin.faces[numbers, 0]].argmax(axis=1)
            pieces = {name: numbers[side == skeleton.joints.index(name)] for name in EYES}
        for name, faces in pieces.items():
            if len(faces) and name == TEXTURED and texture is not None:
                cut = texture.split(skin, faces)
                found.append(Part(name, material, cut.vertices, cut.faces, cut.places))
            elif len(faces):
                used, own = own_numbers(skin.faces[faces])
                places = eye_places(skin.vertices[used]) if name in EYES else None
                found.append(Part(name, material, used, own, places))
    return found
