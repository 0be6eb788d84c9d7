"""Correspondence of a head's vertices with a template that was registered onto the head.

    u = B v  where the head lies on the template's skin,    L u = 0  elsewhere

v are values at the template's vertices, u those at the head's; B has the barycentric coordinates of
the closest points, L is the head's Laplacian, so that what the template does not cover (the bag of
a mouth, the hollow of an eye) follows smoothly. On closed lips, a vertex matches its own lip only.
Eyes and teeth of the head take the values of the template's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from solver.anatomy.contact_regions import LOWER, UPPER, lip_sides
from solver.anatomy.embedding import barycentric, rows_of
from solver.anatomy.template import Template
from solver.drawing.head import skin_parts
from solver.registration.landmarks import landmark_vertices
from solver.surface import Floats, Ints, Surface, adjacency, vertex_normals

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CorrespondenceOptions:
    """Limits of what lies on a template's skin."""

    near_mm: float = 2.5  # from the registered skin ...
    cosine: float = 0.4  # ... facing the same way, at least with this cosine of the normals
    hugging: float = 0.8  # share near of a loose piece that is skin too: a brow, another shell


CORRESPONDENCE = CorrespondenceOptions()


@dataclass(frozen=True)
class HeadParts:
    """Masks (n,) of a head's vertices by part; gums, tongue and the like are in none."""

    skin: Mask
    eyes: Mask  # the eyeballs
    lashes: Mask  # and whatever else lies about the eyes
    teeth: Mask
    lower: Mask  # loose parts of the mouth that move with the lower jaw


def head_parts(head: Surface, person: Template) -> HeadParts:
    """Tell the parts of a head apart by shape, and by the template in its shape, ``person``."""
    count = len(head.vertices)
    piece = connected_components(adjacency(head.faces, count), directed=False)[1]
    kinds = _kinds(head)
    under = person.flesh
    face, shares, distance = barycentric(head.vertices, under)
    near = _lies_on(head, under, under.faces[face], shares, distance)
    skin = kinds["skin"] | (_mean(near, piece) > CORRESPONDENCE.hugging)
    within = _inner_parts(person)
    bones = {"upper": person.cranium, "lower": person.mandible}
    far = [
        _mean(barycentric(head.vertices, within.get(jaw, bone))[2], piece)
        for jaw, bone in bones.items()
    ]
    eyes, lashes, teeth = (kinds[name] & ~skin for name in ("eyes", "lashes", "teeth"))
    return HeadParts(skin, eyes, lashes, teeth, ~(skin | eyes | lashes) & (far[1] < far[0]))


def _kinds(skin: Surface) -> dict[str, Mask]:
    """Return kind of part -> its vertices (n,) of a skin."""
    found = skin_parts(skin)
    nothing = np.zeros(0, np.int64)
    names = ("skin", "eyes", "lashes", "teeth")
    number = np.arange(len(skin.vertices))
    return {name: np.isin(number, skin.faces[found.get(name, nothing)]) for name in names}


def _inner_parts(person: Template) -> dict[str, Surface]:
    """Return the template's ``eyes``, and ``upper`` and ``lower`` teeth with what moves alike."""
    skin = person.skin
    kinds = _kinds(person.skin)
    eyes = kinds["eyes"] | kinds["lashes"]
    mouth = ~kinds["skin"] & ~eyes
    lower = np.isin(np.arange(len(skin.vertices)), person.attached_mandible)
    parts = {"eyes": eyes, "upper": mouth & ~lower, "lower": mouth & lower}
    own = {name: skin.faces[part[skin.faces].all(axis=1)] for name, part in parts.items()}
    return {name: Surface(skin.vertices, faces) for name, faces in own.items() if len(faces)}


def _mean(values: NDArray, piece: Ints) -> Floats:
    """Return the mean (n,) of values (n,) over each vertex's ``piece`` (n,)."""
    return np.asarray((np.bincount(piece, values) / np.bincount(piece))[piece])


@dataclass(frozen=True)
class Correspondence:
    """The template's skin under each vertex of a head."""

    parts: HeadParts
    sides: Ints  # (n,) the nearer lip, UPPER or LOWER, of the head's skin ...
    own_sides: Ints  # (t,) ... and of the template's
    at_mouth: Mask  # (n,) between the corners of the mouth, where lips may touch
    near: Mask  # (n,) vertices that lie on the template
    corners: Ints  # (n, 3) vertices of the template ...
    shares: Floats  # (n, 3) ... and the barycentric coordinates of the closest point between them
    faces: Ints  # (f, 3) of the head

    def among(self, vertices: Ints) -> Mask:
        """Tell which of the head's vertices (n,) lie mostly among some of the template's."""
        share = (np.isin(self.corners, vertices) * self.shares).sum(axis=1)
        return np.asarray(self.near & (share > 0.5))

    def landmarks(self, head: Surface, person: Template, most_mm: float = 6.0) -> dict[str, int]:
        """Return the template's landmarks that have a vertex of the head within ``most_mm``."""
        skin = np.flatnonzero(self.near & self.parts.skin)
        found = {}
        for name, vertex in person.landmarks.items():
            away = np.linalg.norm(head.vertices[skin] - person.skin.vertices[vertex], axis=1)
            away[self.at_mouth[skin] & (self.sides[skin] * self.own_sides[vertex] < 0)] = np.inf
            if away.min(initial=np.inf) < most_mm:
                found[name] = int(skin[away.argmin()])
        return found

    def carrier(self, count: int) -> Carrier:
        """Return what carries values of the template's ``count`` vertices."""
        return Carrier(rows_of(self.corners, self.shares, count), self.near, self.faces)


class Carrier:
    """Takes values (t, d) of a template's vertices to those (n, d) of a head."""

    def __init__(self, rows: sp.csr_array, near: Mask, faces: Ints) -> None:
        graph = adjacency(faces, len(near))
        piece = connected_components(graph, directed=False)[1]
        # a piece that is nowhere near has nothing to follow but its closest points
        self._free = ~near & (_mean(near, piece) > 0)
        laplacian = sp.csr_array(sp.diags_array(graph.sum(axis=1)) - graph)[self._free]
        self._rows = rows
        self._pull = -laplacian[:, ~self._free]
        inner = sp.csc_array(laplacian[:, self._free])
        self._factor = splu(inner) if self._free.any() else None

    def __call__(self, values: Floats) -> Floats:
        """Return the values at the head's vertices."""
        result = np.asarray(self._rows @ values)
        if self._factor is not None:
            result[self._free] = self._factor.solve(np.asarray(self._pull @ result[~self._free]))
        return result


def correspond(head: Surface, person: Template) -> Correspondence:
    """Find what of a template's skin lies under each vertex of a ``head``.

    ``person`` is the template in the head's shape.
    """
    parts = head_parts(head, person)
    count = len(head.vertices)
    skin = Surface(head.vertices, head.faces[parts.skin[head.faces].all(axis=1)])
    under = person.flesh
    within = _inner_parts(person)
    marks = landmark_vertices(person)
    places = {name: person.skin.vertices[vertex] for name, vertex in marks.items()}
    sides = _lips(skin, places)
    own = _lips(under, places)
    at_mouth = _at_mouth(head.vertices, places)
    own_at_mouth = _at_mouth(under.vertices, places)
    corners = np.zeros((count, 3), np.int64)
    shares = np.zeros((count, 3))
    distance = np.full(count, np.inf)

    def lay(part: Mask, on: Surface) -> None:
        if part.any():
            face, shares[part], distance[part] = barycentric(head.vertices[part], on)
            corners[part] = on.faces[face]

    lay(parts.skin, under)
    for side in (UPPER, LOWER):
        other = (own == -side) & own_at_mouth
        lip = under.faces[~other[under.faces].any(axis=1)]
        lay(parts.skin & at_mouth & (sides == side), Surface(under.vertices, lip))
    near = _lies_on(head, under, corners, shares, distance)
    eyes = parts.eyes | parts.lashes
    inner = {"eyes": eyes, "lower": parts.lower, "upper": ~(parts.skin | eyes | parts.lower)}
    for name, part in inner.items():
        lay(part, within.get(name, under))
    return Correspondence(
        parts, sides, own, at_mouth, near | ~parts.skin, corners, shares, head.faces
    )


def _lies_on(
    head: Surface, under: Surface, corners: Ints, shares: Floats, distance: Floats
) -> Mask:
    """Tell which vertices are near ``under`` and face as it does: an eyeball faces its socket."""
    normals = np.einsum("nkd,nk->nd", vertex_normals(under)[corners], shares)
    facing = np.einsum("nd,nd->n", vertex_normals(head), normals)
    return np.asarray((distance < CORRESPONDENCE.near_mm) & (facing > CORRESPONDENCE.cosine))


def _lips(flesh: Surface, places: Mapping[str, Floats]) -> Ints:
    """Return the nearer lip (n,) of each vertex, by the borders of both; 0 where none is known."""
    names = [f"labrale_{lip}us" for lip in ("superi", "inferi")]
    if not set(names) <= places.keys():
        return np.zeros(len(flesh.vertices), np.int64)
    used = np.unique(flesh.faces)
    upper, lower = (
        used[[np.linalg.norm(flesh.vertices[used] - places[name], axis=1).argmin()]]
        for name in names
    )
    return lip_sides(flesh.vertices, flesh.faces, upper, lower)


def _at_mouth(points: Floats, places: Mapping[str, Floats]) -> Mask:
    """Tell which points lie between the corners of the mouth."""
    if not {"cheilion_l", "cheilion_r"} <= places.keys():
        return np.zeros(len(points), bool)
    right, left = (places[f"cheilion_{side}"][0] for side in "rl")
    return np.asarray((points[:, 0] > right) & (points[:, 0] < left))
