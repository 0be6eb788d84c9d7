"""Named parts of the skin that touch each other: teeth, lips' linings, eyeballs and lids.

Contact between them is solved elsewhere; here is only which vertices take part in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from solver.surface import Floats, Ints, Surface, directed_edges, vertex_normals

# A place on the skin belongs to the lip whose middle is nearer on the surface.
#
# The way from one lip to the other leads around a corner of the mouth, so that no plane is needed,
# which a bent line of the mouth or an overbite would cross.

UPPER = 1  # lip; 0 is neither
LOWER = -1  # lip
SIDES = ("left", "right")  # the subject's


def lips_apart(flesh: Surface, landmarks: Mapping[str, int]) -> Ints:
    """Return :func:`lip_sides` of a flesh by its landmarks (name -> vertex).

    From the edges of the lips at the mid-line both ways to a corner of the mouth are equally long.
    """
    upper, lower = stomia(landmarks)
    return lip_sides(flesh.vertices, flesh.faces, np.array([upper]), np.array([lower]))


def lip_sides(skin: Floats, faces: Ints, upper: Ints, lower: Ints) -> Ints:
    """Return for each skin vertex :data:`UPPER` or :data:`LOWER`, 0 where neither is reached.

    ``skin`` (V, 3) is in mm; ``faces`` (f, 3) are the triangles of the flesh: teeth and eyes are
    not walked on. ``upper`` and ``lower`` are vertices on the middle of each lip.
    """
    edges = directed_edges(faces)
    lengths = np.linalg.norm(skin[edges[:, 0]] - skin[edges[:, 1]], axis=1)
    graph = sp.coo_array((lengths, tuple(edges.T)), shape=(len(skin), len(skin))).tocsr()
    to_upper, to_lower = (
        dijkstra(graph, directed=False, indices=seeds, min_only=True) for seeds in (upper, lower)
    )
    return np.asarray(UPPER * (to_upper < to_lower) + LOWER * (to_lower < to_upper))


def stomia(landmarks: Mapping[str, int]) -> list[int]:
    """Return the vertices at the mid-line's edges of the upper and the lower lip, if named."""
    names = ("stomion_superius", "stomion_inferius")
    return [landmarks[name] for name in names if name in landmarks]


def eye_corners(landmarks: Mapping[str, int]) -> dict[str, Ints]:
    """Return ``left`` and ``right`` -> the vertices (2,) of inner and outer corner, where named."""
    names = {side: [f"{end}canthion_{side[0]}" for end in ("endo", "exo")] for side in SIDES}
    return {
        side: np.array([landmarks[name] for name in pair])
        for side, pair in names.items()
        if landmarks.keys() >= set(pair)
    }


@dataclass(frozen=True)
class ContactDistances:
    """Distances by which skin belongs to a contact region."""

    lining_mm: float = 6.0  # lips' lining lies this near to the teeth that lips cover
    lid_mm: float = 4.0  # lids lie this near to the eyeball
    # And no deeper in it: skin that goes on behind the lids, in the socket, is none of them.
    on_ball_mm: float = 0.2
    front_teeth: float = 0.5  # part of the teeth's length, from the front, that lips cover


DISTANCES = ContactDistances()


def contact_regions(
    flesh: Surface, sides: Ints, parts: Mapping[str, Ints], landmarks: Mapping[str, int]
) -> dict[str, Ints]:
    """Return region -> skin vertices, sorted.

    ``flesh`` has all vertices (V, 3) of the template's skin in mm, with only the triangles that
    bound the flesh: face, lips and linings. ``sides`` (V,) are the lips that vertices belong to
    (:func:`lip_sides`): the nearer teeth say nothing, as upper ones stand before the lower lip.
    ``parts`` are the vertices of ``upper_teeth``, ``lower_teeth``, ``left_eyeball`` and
    ``right_eyeball``; ``landmarks`` (name -> vertex) has the four canthi (``endocanthion_l`` ...).
    """
    regions = {name: np.sort(ids) for name, ids in parts.items()}
    skin = flesh.vertices
    own = np.unique(flesh.faces)
    rows = [skin[parts[f"{jaw}_teeth"]] for jaw in ("upper", "lower")]
    # those that lips cover
    front = [row[row[:, 2] > np.quantile(row[:, 2], 1 - DISTANCES.front_teeth)] for row in rows]
    lining = own[cKDTree(np.vstack(front)).query(skin[own])[0] < DISTANCES.lining_mm]
    for lip, side in (("upper", UPPER), ("lower", LOWER)):
        regions[f"{lip}_lip_lining"] = lining[sides[lining] == side]
    for eye, corners in eye_corners(landmarks).items():
        regions |= _lids(flesh, own, parts[f"{eye}_eyeball"], corners, eye)
    return regions


def _lids(flesh: Surface, own: Ints, eyeball: Ints, corners: Ints, side: str) -> dict[str, Ints]:
    """Split the skin on one eyeball along the line between the corners of the eye."""
    skin = flesh.vertices
    ball = flesh.vertices[eyeball]
    centre = (ball.min(axis=0) + ball.max(axis=0)) / 2
    radius = np.median(np.linalg.norm(ball - centre, axis=1))
    away = skin[own] - centre
    height = np.linalg.norm(away, axis=1) - radius
    outward = (away * vertex_normals(flesh)[own]).sum(axis=1) > 0
    on_lid = (height > -DISTANCES.on_ball_mm) & (height < DISTANCES.lid_mm)
    own = own[outward & on_lid & (away[:, 2] > 0)]
    inner, outer = sorted(skin[corners], key=lambda point: float(point[0]))
    line = np.interp(skin[own, 0], [inner[0], outer[0]], [inner[1], outer[1]])
    above = skin[own, 1] > line
    return {f"{side}_upper_lid": own[above], f"{side}_lower_lid": own[~above]}


def first_match(vertices: Ints, tests: Mapping[str, np.ndarray]) -> dict[str, Ints]:
    """Return region -> those of ``vertices`` (k,) whose first passed test (k,) is the region's."""
    free = np.ones(len(vertices), dtype=bool)
    regions = {}
    for name, test in tests.items():
        regions[name] = vertices[free & test]
        free &= ~test
    return regions
