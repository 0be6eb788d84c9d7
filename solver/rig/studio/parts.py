"""Parts of a head that are meshes of their own: skin, each eye, teeth, gums, tongue and lashes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.drawing.head import skin_parts
from solver.rig.studio.eyes import eye_places
from solver.rig.studio.skeleton import EYES, Skeleton
from solver.surface import Floats, Ints, Surface, adjacency, own_numbers

TEXTURED = "skin"  # the part that a person's images lie on


@dataclass(frozen=True)
class TongueSizes:
    """What tells a tongue from gums, by the width of the rows of teeth."""

    most_width: float = 0.85
    least_depth: float = 0.5  # that no glob of gum between two teeth has


TONGUE = TongueSizes()


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

    With ``texture``, the skin has places in its images. Gums and tongue of a template in which they
    hang together are one part, ``mouth``.
    """
    found = []
    for material, numbers in _with_tongue(skin, skin_parts(skin)).items():
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


def _with_tongue(
    skin: Surface, parts: dict[str, Ints], sizes: TongueSizes = TONGUE
) -> dict[str, Ints]:
    """Return faces of parts with a ``mouth`` split in ``gums`` and ``tongue``, if it can be.

    A tongue is deeper than wide and lies between the rows of teeth, while gums are as wide as
    these.
    """
    if not {"mouth", "teeth"} <= parts.keys():
        return parts
    teeth = float(np.ptp(skin.vertices[skin.faces[parts["teeth"]].ravel(), 0]))
    numbers = parts["mouth"]
    faces = skin.faces[numbers]
    graph = adjacency(faces, len(skin.vertices))
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    is_tongue = np.zeros(len(faces), bool)
    for piece in np.unique(label):
        own = label == piece
        across, _, deep = np.ptp(skin.vertices[faces[own].ravel()], axis=0)
        if across < sizes.most_width * teeth and deep > max(across, sizes.least_depth * teeth):
            is_tongue |= own
    if not is_tongue.any():
        return parts
    split = {"gums": numbers[~is_tongue], "tongue": numbers[is_tongue]}
    kept = {name: own for name, own in parts.items() if name != "mouth"}
    return kept | {name: own for name, own in split.items() if len(own)}
