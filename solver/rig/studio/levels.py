"""Levels of detail: a light rig of fewer triangles, its shapes and weights carried over."""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import scipy.sparse as sp

from solver.anatomy.embedding import barycentric
from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.rig.studio.light_rig import HalfWay, LightRig
from solver.rig.studio.parts import parts_of
from solver.surface import Floats, Surface, join_surfaces, own_numbers

LEAST_FACES = 60  # a part keeps so many: eyeballs stay round
OPENED = {"jawOpen": 0.6, "mouthFunnel": 0.3}


def simplify(rig: LightRig, share: float) -> LightRig:
    """Return a rig with about a ``share`` of the triangles of each part.

    Edges collapse where the surface changes least (quadric errors, Garland and Heckbert 1997), with
    the mouth open, so that lips stay apart; each vertex that is left is a place of the whole skin.
    """
    full = rig.neutral
    opened = rig.play(OPENED)
    surfaces = []
    rows = []
    for part in parts_of(full, rig.skeleton):
        own = Surface(opened[part.vertices], part.faces)
        count = max(round(share * len(part.faces)), LEAST_FACES)
        vertices, faces, *_ = igl.qslim(
            np.asfortranarray(own.vertices), np.asfortranarray(own.faces.astype(np.int32)), count
        )
        place = _places(vertices, own) @ _columns(part.vertices, len(full.vertices))
        surfaces.append(Surface(np.asarray(place @ full.vertices), np.ascontiguousarray(faces)))
        rows.append(place)
    carry = sp.csr_array(sp.vstack(rows))
    whole = join_surfaces(surfaces)

    def carried(motions: Floats) -> Floats:
        flat = motions.transpose(1, 0, 2).reshape(len(full.vertices), -1)
        return np.asarray(carry @ flat).reshape(len(whole.vertices), -1, 3).transpose(1, 0, 2)

    return replace(
        rig,
        neutral=whole,
        motions=carried(rig.motions),
        skeleton=replace(rig.skeleton, weights=np.asarray(carry @ rig.skeleton.weights)),
        half_ways=tuple(HalfWay(each.of, carried(each.motion[None])[0]) for each in rig.half_ways),
    )


def carry_texture(
    coordinates: TextureCoordinates, full: Surface, level: Surface
) -> TextureCoordinates:
    """Return texture coordinates of a level's triangles by those of the ``full`` skin.

    A triangle lies in the chart that is nearest to its middle; its corners have the coordinates of
    the places in that chart which are nearest to them. What lies in no chart, as an eyeball behind
    its lids, is no part of the skin.
    """
    middles = level.vertices[level.faces].mean(axis=1)
    mapped = coordinates.mapped
    _, nearest, _ = igl.point_mesh_squared_distance(middles, full.vertices, full.faces[mapped])
    chart_of = coordinates.charts
    chart = chart_of[mapped[nearest]]
    corners = np.full(level.faces.shape, NOWHERE, np.int32)
    places = [np.zeros((0, 2))]
    count = 0
    for number in np.unique(chart[chart != NOWHERE]):
        own = np.flatnonzero(chart == number)
        used, ours = own_numbers(level.faces[own])
        faces = np.flatnonzero(chart_of == number)
        part = Surface(full.vertices, full.faces[faces])
        face, shares, _ = barycentric(level.vertices[used], part)
        at = coordinates.places[coordinates.corners[faces[face]]].astype(np.float64)
        places.append(np.einsum("nc,ncd->nd", shares, at))
        corners[own] = ours + count
        count += len(used)
    return TextureCoordinates(np.vstack(places).astype(np.float32), corners)


def distance_mm(rig: LightRig, level: LightRig) -> Floats:
    """Return how far (s,) the skin of each whole shape is off the level's surface, mean, mm."""
    found = []
    for name in rig.names:
        fine = rig.play({name: 1.0})
        coarse = np.asfortranarray(level.play({name: 1.0}))
        squared = igl.point_mesh_squared_distance(fine, coarse, level.neutral.faces)[0]
        found.append(np.sqrt(squared).mean())
    return np.array(found)


def _places(points: Floats, surface: Surface) -> sp.csr_array:
    """Return the matrix (k, v) of the surface's places nearest to ``points`` (k, 3)."""
    face, shares, _ = barycentric(points, surface)
    corners = surface.faces[face]
    lines = np.repeat(np.arange(len(points)), 3)
    entries = (shares.ravel(), (lines, corners.ravel()))
    return sp.csr_array(entries, shape=(len(points), len(surface.vertices)))


def _columns(vertices: np.ndarray, count: int) -> sp.csr_array:
    """Return the matrix (k, count) that picks ``vertices`` (k,)."""
    entries = (np.ones(len(vertices)), (np.arange(len(vertices)), vertices))
    return sp.csr_array(entries, shape=(len(vertices), count))
