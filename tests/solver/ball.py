"""A ball for a head: the smallest template that has skin, bones, a muscle and parting lips."""

from functools import cache

import numpy as np
import trimesh

from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.template import Muscle, Template
from solver.surface import Surface

EDGE_MM = 18.0


def ball(centre, radius, subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Surface(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, np.int64))


def ball_template():
    skin = ball([0, 0, 0], 60.0)
    up = skin.vertices[:, 1]
    z = skin.vertices[:, 2]
    parting = np.zeros_like(skin.vertices)
    parting[:, 1] = 3 * np.exp(-(((up + 15) / 10) ** 2)) * (z > 0)
    # wide enough that some vertex of the skull always lies under it
    surface = ball([0, 0, 0], 6.0, 2)
    surface = surface.with_vertices(surface.vertices * [3, 2, 1] + [0, 10, 45])
    muscle = Muscle(
        "frontalis",
        surface,
        np.array([0.0, 0, 1]),
        np.array([0, 10.0, 39]),
        np.array([0, 10.0, 51]),
    )
    return Template(
        name="ball",
        version="1",
        source="test",
        skin=skin,
        flesh_faces=np.arange(len(skin.faces)),
        face_vertices=np.flatnonzero((z > 5) & (up > -40)),
        attached_cranium=np.flatnonzero(z < -20),
        attached_mandible=np.array([], dtype=np.int64),
        parting=parting,
        cranium=ball([0, 15, 0], 36.0),
        mandible=ball([0, -36, 12], 10.0),
        muscles=(muscle,),
        condyles=np.array([[30.0, 0, 0], [-30.0, 1, 0]]),
        back_z=0.0,
        bottom_y=-52.0,
    )


@cache
def meshed_ball() -> Template:
    """Return it with tets of :data:`EDGE_MM`, which take seconds: the cache keeps them."""
    return find_or_make_mesh(ball_template(), EDGE_MM)
