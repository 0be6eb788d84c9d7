"""What registration needs to know of a template beside its vertices, found once per template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.template import Template
from solver.registration.hidden import rigid_groups
from solver.registration.outer import outer_skin
from solver.surface import Ints

TOUCHING_MM = 1.2
PARTED_MM = 1.0
MOBILE_MM = 0.4
"""Root mean square displacement over the expressions that halves a vertex's stability."""
STABLE_REGIONS = ("forehead", "nose")


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
    touching: Ints
    groups: list[Ints]
    stable: np.ndarray


def topology(template: Template) -> Topology:
    """Find outer skin, lips that touch, rigid parts and stable skin of a template."""
    outer = np.flatnonzero(outer_skin(template))
    flesh = template.skin.faces[template.flesh_faces]
    return Topology(
        template=template,
        flesh=flesh,
        outer=outer,
        face=np.intersect1d(template.face_vertices, outer),
        touching=_touching(template, np.unique(flesh)),
        groups=rigid_groups(template),
        stable=_stable(template, outer),
    )


def _touching(template: Template, vertices: Ints) -> Ints:
    rest = template.skin.vertices
    pairs = cKDTree(rest[vertices]).query_pairs(TOUCHING_MM, output_type="ndarray")
    one, other = vertices[pairs].T
    gap = np.linalg.norm(rest[one] - rest[other], axis=1)
    parted = rest + template.parting
    wide = np.linalg.norm(parted[one] - parted[other], axis=1)
    apart = wide > 3 * gap + PARTED_MM
    return np.stack([one[apart], other[apart]], axis=1)


def _stable(template: Template, outer: Ints) -> np.ndarray:
    """Weigh by how little the expressions move a vertex; without shapes, by named regions."""
    weights = np.zeros(len(template.skin.vertices))
    if template.shapes is not None and len(template.shapes.expressions):
        squares = np.sum(template.shapes.expressions[:, outer].astype(float) ** 2, axis=2)
        weights[outer] = 1 / (1 + squares.mean(axis=0) / MOBILE_MM**2) ** 2
        return weights
    named = [template.regions[name] for name in STABLE_REGIONS if name in template.regions]
    weights[np.concatenate(named) if named else template.face_vertices] = 1.0
    weights[np.setdiff1d(np.arange(len(weights)), outer)] = 0.0
    return weights
