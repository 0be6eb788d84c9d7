"""A head made of balls: the least anatomy that a template's report finds nothing wrong with."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import trimesh

from solver.anatomy.template import Depth, Muscle, Template, TemplateMesh
from solver.registration.landmarks import IBUG_68
from solver.surface import Surface


def ball(centre: tuple[float, float, float], radius: float, fineness: int = 2) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=fineness, radius=radius)
    return Surface(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, dtype=np.int64))


def muscle(name: str, x: float) -> Muscle:
    origin = np.array([x, -10.0, 66.0])
    insertion = np.array([x, -10.0, 90.0])
    return Muscle(name, ball((x, -10, 80), 8.0), np.array([0.0, 0.0, 1.0]), origin, insertion)


def ball_head() -> Template:
    """Return a ball of 100 mm with a skull, a jaw, two muscles and one tetrahedron."""
    skin = ball((0, 0, 0), 100.0, 3)
    front = np.flatnonzero(skin.vertices[:, 2] > 5)
    tip = int(np.argmax(skin.vertices[:, 2]))
    left, right = (int(front[np.argmax(sign * skin.vertices[front, 0])]) for sign in (1, -1))
    places = {"l": left, "r": right}
    landmarks = {name: places.get(name.rpartition("_")[2], tip) for name in IBUG_68.values()}
    count = len(front)
    mesh = TemplateMesh(
        edge_mm=9.0,
        vertices=np.array([[0.0, 0, 0], [200, 0, 0], [0, 200, 0], [0, 0, 200]]),
        tets=np.array([[0, 1, 2, 3]]),
        cranium=np.zeros(0, np.int64),
        mandible=np.zeros(0, np.int64),
        cut=np.zeros(0, np.int64),
        embedded=front,
        embedded_in=np.zeros(count, np.int64),
        shares=np.full((count, 4), 0.25),
        attached_mandible=np.zeros(0, np.int64),
        weights=sp.csr_array(np.array([[0.99, 0.005, 0.005]])),
    )
    return Template(
        name="ball",
        version="1",
        source="by hand",
        licence="CC0 1.0",
        skin=skin,
        flesh_faces=np.arange(len(skin.faces)),
        face_vertices=front,
        attached_cranium=np.zeros(0, np.int64),
        attached_mandible=np.zeros(0, np.int64),
        parting=np.full_like(skin.vertices, 1.0),
        cranium=ball((0, 25, 10), 60.0),
        mandible=ball((0, -60, 20), 22.0),
        muscles=(muscle("puller_l", 20.0), muscle("puller_r", -20.0)),
        condyles=np.array([[20.0, -55.0, 20.0], [-20.0, -55.0, 20.0]]),
        back_z=-50.0,
        bottom_y=-101.0,
        landmarks={**landmarks, "tip": tip, "side_l": left, "side_r": right},
        regions={"face": front},
        depths=(Depth("tip", "cranium", 36.0, 2.0, "by construction"),),
        mesh=mesh,
    )
