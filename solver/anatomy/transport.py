"""A template's tetrahedra carried into a person: the same tets, muscles and S for everybody.

The skin's warp carries all vertices; then the mesh is relaxed, pulled by the person's skin through
its embedding and by the person's bones through the places it has on the template's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.anatomy.embedding import barycentric
from solver.anatomy.guidance import guidance
from solver.anatomy.relaxation import relaxed
from solver.anatomy.template import Template
from solver.anatomy.template_mesh import TemplateMesh
from solver.anatomy.warp import Warp
from solver.surface import Floats, Surface


def transport(template: Template, person: Template, mesh: TemplateMesh, warp: Warp) -> TemplateMesh:
    """Return the template's ``mesh`` in a person.

    Parameters
    ----------
    template
        The head the mesh was made for.
    person
        The template carried into the person by ``warp``.
    mesh
        The mesh to carry.
    warp
        The map of space between their skins.

    Raises
    ------
    SolveError
        ``mesh.inverted``.
    """
    start = warp(mesh.vertices)
    held = np.concatenate([mesh.cranium, mesh.sliding, mesh.mandible, mesh.cut])
    place = start.copy()
    cranium = np.concatenate([mesh.cranium, mesh.sliding])
    for ids, before, after in (
        (cranium, template.cranium, person.cranium),
        (mesh.mandible, template.mandible, person.mandible),
    ):
        place[ids] = _follow(mesh.vertices[ids], before, after)
    guides = guidance(
        person,
        person.skin.vertices,
        mesh.embedded,
        mesh.surface_rows,
        held,
        place[held],
        start,
    )
    return replace(mesh, vertices=relaxed(start, mesh.tets, guides))


def _follow(points: Floats, before: Surface, after: Surface) -> Floats:
    """Return where points (n, 3) near a surface go when it moves."""
    face, shares, _ = barycentric(points, before)
    moved = (after.vertices - before.vertices)[before.faces[face]]
    return np.asarray(points + np.einsum("nk,nkd->nd", shares, moved))
