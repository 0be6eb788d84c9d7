"""A template's tetrahedra carried into a person: the same tets, muscles and S for everybody.

The skin's warp carries all vertices; then the mesh is relaxed, pulled by the person's skin through
its embedding and by the person's bones through the places it has on the template's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.anatomy.embedding import barycentric
from solver.anatomy.flesh_motion import FleshMotion
from solver.anatomy.guidance import guidance
from solver.anatomy.relaxation import relaxed
from solver.anatomy.template import Template
from solver.anatomy.template_mesh import TemplateMesh
from solver.anatomy.tetrahedra import dihedral_angles
from solver.anatomy.transfer import carried_muscle
from solver.anatomy.warp import Warp
from solver.errors import SolveError
from solver.surface import Floats, Surface

LEAST_DEG = 5.0
"""A mesh with a smaller dihedral angle is of no use."""


def transport(
    template: Template, mesh: TemplateMesh, person: Template, warp: Warp
) -> tuple[TemplateMesh, Template]:
    """Return the template's mesh in a person, and the person with muscles moved as their tets are.

    Parameters
    ----------
    template
        The head the mesh was made for.
    mesh
        The template's tets.
    person
        The template carried into the person by ``warp``.
    warp
        The map of space between their skins.

    Raises
    ------
    SolveError
        ``mesh.inverted`` or ``mesh.flat``.
    """
    start = warp(mesh.vertices)
    place = start.copy()
    cranium = np.concatenate([mesh.cranium, mesh.sliding])
    for ids, before, after in (
        (cranium, template.cranium, person.cranium),
        (mesh.mandible, template.mandible, person.mandible),
    ):
        place[ids] = _follow(mesh.vertices[ids], before, after)
    held = np.concatenate([cranium, mesh.mandible, mesh.cut])
    guides = guidance(
        person, person.skin.vertices, mesh.embedded, mesh.surface_rows, held, place[held], start
    )
    moved = relaxed(start, mesh.tets, guides)
    narrow = dihedral_angles(moved, mesh.tets).min()
    if narrow < LEAST_DEG:
        raise SolveError(
            "mesh.flat",
            f"a tetrahedron is left with a dihedral angle of {narrow:.1f} degrees",
            degrees=float(narrow),
        )
    motion = FleshMotion(mesh.vertices, mesh.tets, moved, warp)
    muscles = tuple(carried_muscle(muscle, motion) for muscle in template.muscles)
    return replace(mesh, vertices=moved), replace(person, muscles=muscles)


def _follow(points: Floats, before: Surface, after: Surface) -> Floats:
    """Return where points (n, 3) near a surface go when it moves."""
    face, shares, _ = barycentric(points, before)
    moved = (after.vertices - before.vertices)[before.faces[face]]
    return np.asarray(points + np.einsum("nk,nkd->nd", shares, moved))
