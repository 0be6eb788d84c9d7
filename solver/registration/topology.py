"""What registration needs to know of a template beside its vertices, found once per template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.registration.hidden import rigid_groups
from solver.registration.outer import outer_skin
from solver.surface import Floats, Ints

TOUCHING_MM = 2.1
FAR_MM = 8.0
BELOW_TIP_MM = 8.0
PARTED_SHARE = 0.3
"""Share of the widest parting by which lips that touch come apart."""
MOBILE_MM = 0.4
"""Root mean square displacement over the expressions that halves a vertex's stability."""


@dataclass(frozen=True)
class Topology:
    """A template's skin as registration sees it.

    template
        The template itself.
    flesh
        (f, 3) faces that deform; the rest is carried along.
    outer
        (k,) vertices that a scanner sees.
    face
        (j,) outer vertices of the face: where it is looked for and where errors are reported.
    firm
        (i,) vertices of the face that no expression moves far: where it is looked for in one.
    touching
        (p, 2) vertices that touch at rest and part when the mouth opens: the lips.
    groups
        Vertices of the parts that move rigidly (eyes, teeth).
    stable
        (n,) weights in [0, 1]: 1 where the skin lies still on the skull.
    """

    template: Template
    flesh: Ints
    outer: Ints
    face: Ints
    firm: Ints
    touching: Ints
    groups: list[Ints]
    stable: Floats


def topology(template: Template) -> Topology:
    """Find outer skin, lips that touch, rigid parts and stable skin of a template."""
    outer = np.flatnonzero(outer_skin(template))
    flesh = template.skin.faces[template.flesh_faces]
    face = np.intersect1d(template.face_vertices, outer)
    firm = _firm(template, face)
    return Topology(
        template=template,
        flesh=flesh,
        outer=outer,
        face=face,
        firm=firm,
        touching=_touching(template, np.unique(flesh)),
        groups=rigid_groups(template),
        stable=_stable(template, outer, firm),
    )


def _touching(template: Template, vertices: Ints) -> Ints:
    """Pair every lip vertex with the closest one that parting takes away from it, each once."""
    rest = template.skin.vertices
    parted = rest + template.parting
    pairs = vertices[cKDTree(rest[vertices]).query_pairs(TOUCHING_MM, output_type="ndarray")]
    gap, opened = (
        np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
        for points in (rest, parted)
    )
    opened -= gap
    apart = np.flatnonzero(opened > PARTED_SHARE * opened.max(initial=0.0))
    chosen: list[Ints] = []
    taken: set[int] = set()
    for pair in pairs[apart[np.argsort(gap[apart], kind="stable")]]:
        if taken.isdisjoint(pair.tolist()):
            taken.update(pair.tolist())
            chosen.append(pair)
    return np.array(chosen, dtype=np.int64).reshape(-1, 2)


def _firm(template: Template, face: Ints) -> Ints:
    """Leave out what moves farther than :data:`FAR_MM`; without shapes, what is below the nose."""
    if template.shapes is not None and len(template.shapes.expressions):
        moves = np.linalg.norm(template.shapes.expressions[:, face], axis=2).max(axis=0)
        return np.asarray(face[moves < FAR_MM])
    points = template.skin.vertices[face]
    tip = points[np.argmax(points[:, 2])]
    return np.asarray(face[points[:, 1] > tip[1] - BELOW_TIP_MM])


def _stable(template: Template, outer: Ints, firm: Ints) -> Floats:
    """Weigh by how little the expressions move a vertex; without shapes the upper face counts."""
    weights = np.zeros(len(template.skin.vertices))
    if template.shapes is not None and len(template.shapes.expressions):
        squares = np.sum(template.shapes.expressions[:, outer].astype(float) ** 2, axis=2)
        weights[outer] = 1 / (1 + squares.mean(axis=0) / MOBILE_MM**2) ** 2
    else:
        weights[firm] = 1.0
    return weights
