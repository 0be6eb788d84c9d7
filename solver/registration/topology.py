"""Properties of a template that registration needs, found once per template."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.anatomy.warp import interpolate, spread
from solver.drawing.head import skin_parts
from solver.drawing.render import Camera, look
from solver.similarity import robust_weights, weighted_motion
from solver.surface import Floats, Ints

# Parts that no scan shows: eyeballs, teeth, gums and tongue go where the skin takes them.

GUIDES = 500  # points of the outer skin that carry what is hidden
SMOOTHING_MM = 5.0  # of the warp between them
NO_VERTICES: Ints = np.zeros(0, np.int64)


def rigid_groups(template: Template) -> list[Ints]:
    """Return the vertices of what moves as one: each eye with its lashes, each jaw's teeth."""
    skin = template.skin
    parts = {name: np.unique(skin.faces[faces]) for name, faces in skin_parts(skin).items()}
    eyes, mouth = (
        np.unique(np.concatenate([parts.get(name, NO_VERTICES) for name in names]))
        for names in (("eyes", "lashes"), ("teeth", "mouth"))
    )
    is_left = skin.vertices[eyes, 0] > 0
    is_lower = np.isin(mouth, template.attached_mandible)
    groups = [eyes[is_left], eyes[~is_left], mouth[is_lower], mouth[~is_lower]]
    return [group for group in groups if len(group)]


def carry_hidden(
    groups: list[Ints], rest: Floats, start: Floats, fitted: Floats, outer: Ints
) -> Floats:
    """Return ``fitted`` (n, 3) with every group moved rigidly from ``rest`` (n, 3).

    A group goes where the shapes have put it in ``start`` (n, 3), and from there with the outer
    skin around it, vertices ``outer`` (k,), which free-form registration took to ``fitted``.
    """
    guides = outer[spread(start[outer], GUIDES)]
    warp = interpolate(start[guides], fitted[guides], SMOOTHING_MM)
    result = fitted.copy()
    for group in groups:
        motion = weighted_motion(rest[group], warp(start[group]), np.ones(len(group)))
        result[group] = motion(rest[group])
    return result


# Which skin a scanner can see: not the linings of mouth, nose and lids.


def outer_skin(template: Template) -> NDArray[np.bool_]:
    """Return which skin vertices (n,) of the template's flesh are seen from outside."""
    skin = template.skin
    pixels = TOPOLOGY.pixels
    centre = (skin.vertices.min(axis=0) + skin.vertices.max(axis=0)) / 2
    span = 1.2 * float(np.ptp(skin.vertices, axis=0).max())
    seen = np.zeros(len(skin.faces), dtype=bool)
    for yaw, pitch in product(np.radians(TOPOLOGY.yaws), np.radians(TOPOLOGY.pitches)):
        triangle = look(Camera(centre, span, yaw, pitch), skin, pixels, pixels).triangle
        seen[np.unique(triangle[triangle >= 0])] = True
    flesh = template.flesh_faces
    outer = np.zeros(len(skin.vertices), dtype=bool)
    outer[skin.faces[flesh][seen[flesh]]] = True
    return outer


@dataclass(frozen=True)
class TopologyOptions:
    """Lips, still and outer skin of a template at rest; lengths in mm."""

    touching: float = 2.1  # between vertices of closed lips
    below_tip: float = 8.0  # of the nose, skin is not still, for all that is known without shapes
    parted_share: float = 0.3  # of the widest parting by which lips come apart
    mobile: float = 0.4  # root mean square move that halves a vertex's stability
    # Views of a head that see all its outer skin: pixels of a side, and degrees.
    pixels: int = 640
    yaws: tuple[int, ...] = (0, 30, 60, 90, 130, 180, 230, 270, 300, 330)
    pitches: tuple[int, ...] = (-35, 0, 35)


TOPOLOGY = TopologyOptions()


@dataclass(frozen=True)
class Topology:
    """A template's skin as registration sees it."""

    template: Template
    flesh: Ints  # (f, 3) faces that deform; the rest is carried along
    outer: Ints  # (k,) vertices that a scanner sees
    face: Ints  # (j,) outer vertices of the face, where errors are reported
    touching: Ints  # (p, 2) vertices that touch at rest and part with the mouth: the lips
    groups: list[Ints]  # vertices of each part that moves rigidly (eyes, teeth)
    stable: Floats  # (n,) weights in [0, 1]: 1 where the skin lies still on the skull


def topology(template: Template) -> Topology:
    """Find outer skin, lips that touch, rigid parts and stable skin of a template."""
    outer = np.flatnonzero(outer_skin(template))
    flesh = template.skin.faces[template.flesh_faces]
    face = np.intersect1d(template.face_vertices, outer)
    touching = _touching(template, np.unique(flesh))
    stable = _stable(template, outer, face)
    return Topology(template, flesh, outer, face, touching, rigid_groups(template), stable)


def _touching(template: Template, vertices: Ints) -> Ints:
    """Pair every lip vertex with the closest one that parting takes away from it, each once."""
    rest = template.skin.vertices
    pairs = vertices[cKDTree(rest[vertices]).query_pairs(TOPOLOGY.touching, output_type="ndarray")]
    gap, parted = (
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        for points in (rest, rest + template.parting)
    )
    opened = parted - gap
    apart = np.flatnonzero(opened > TOPOLOGY.parted_share * opened.max(initial=0.0))
    chosen: list[Ints] = []
    taken: set[int] = set()
    for pair in pairs[apart[np.argsort(gap[apart], kind="stable")]]:
        if taken.isdisjoint(pair.tolist()):
            taken.update(pair.tolist())
            chosen.append(pair)
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def _stable(template: Template, outer: Ints, face: Ints) -> Floats:
    """Weigh by how little the expressions move a vertex; without shapes the upper face counts."""
    weights = np.zeros(len(template.skin.vertices))
    if template.shapes is not None and len(template.shapes.expressions):
        squares = np.sum(template.shapes.expressions[:, outer].astype(float) ** 2, axis=2)
        weights[outer] = robust_weights(squares.mean(axis=0) / TOPOLOGY.mobile**2)
    else:
        points = template.skin.vertices[face]
        tip = points[np.argmax(points[:, 2])]
        weights[face[points[:, 1] > tip[1] - TOPOLOGY.below_tip]] = 1.0
    return weights
