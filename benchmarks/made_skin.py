"""Skin with pores and furrows of known depth, on a face subdivided finely: scans made in code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from solver.surface import Floats, Ints, Surface, area_normals, vertex_normals


@dataclass(frozen=True)
class Relief:
    """What is carved into a face; lengths in mm."""

    pores: int = 4000
    pore_depth: tuple[float, float] = (0.05, 0.15)
    pore_radius: tuple[float, float] = (0.5, 0.9)  # at which a pit's depth has fallen to 1/e
    furrow_depth: float = 0.5  # the deepest
    furrow_radius: float = 1.2
    seed: int = 0


RELIEF = Relief()
FURROWS = (  # height over the nose's tip, half width, share of the depth: lines of the forehead
    (58.0, 34.0, 0.6),
    (66.0, 40.0, 1.0),
    (74.0, 36.0, 0.8),
)
FOLDS = (  # from and to, right and up from the nose's tip: beside mouth and eyes
    ((18.0, -4.0), (32.0, -30.0), 1.0),
    ((46.0, 30.0), (58.0, 38.0), 0.5),
    ((46.0, 27.0), (59.0, 27.0), 0.5),
)


def pits(skin: Surface, face: Ints, places: Floats, relief: Relief = RELIEF) -> Floats:
    """Return the heights (n,) of pores, at random on the face, at ``places`` (n, 3)."""
    rng = np.random.default_rng(relief.seed)
    corners = skin.faces[face]
    area = np.linalg.norm(area_normals(skin.vertices, corners), axis=1)
    chosen = rng.choice(len(corners), relief.pores, p=area / area.sum())
    shares = rng.dirichlet(np.ones(3), relief.pores)
    middles = np.einsum("nc,ncd->nd", shares, skin.vertices[corners[chosen]])
    depths = rng.uniform(*relief.pore_depth, relief.pores)
    radii = rng.uniform(*relief.pore_radius, relief.pores)
    apart, near = cKDTree(middles).query(places, 4)
    pit = depths[near] * np.exp(-((apart / radii[near]) ** 2))
    return np.asarray(-pit.max(axis=1))


def furrows(skin: Surface, places: Floats, relief: Relief = RELIEF) -> Floats:
    """Return the heights (n,) of lines on the forehead, beside mouth and eyes, at ``places``."""
    tip = skin.vertices[skin.vertices[:, 2].argmax()]
    x, y, z = (places - tip).T
    found = np.zeros(len(places))
    for height, half, share in FURROWS:
        off = y - height - 1.5 * np.sin(x / 9.0)
        fade = np.clip((half - np.abs(x)) / 8.0, 0.0, 1.0)
        found = np.maximum(found, share * fade * np.exp(-((off / relief.furrow_radius) ** 2)))
    for start, end, share in FOLDS:
        one = np.array(start)
        along = np.array(end) - one
        at = np.stack([np.abs(x), y], axis=1) - one
        part = np.clip(at @ along / (along @ along), 0.0, 1.0)
        off = np.linalg.norm(at - part[:, None] * along, axis=1)
        fade = np.minimum(1.0, 4.0 * part * (1.0 - part))
        found = np.maximum(found, share * fade * np.exp(-((off / relief.furrow_radius) ** 2)))
    return np.where(z > -90.0, -relief.furrow_depth * found, 0.0)


def carve(fine: Surface, heights: Floats) -> Surface:
    """Return a fine surface with its vertices moved along their normals by ``heights`` (n,)."""
    return fine.with_vertices(fine.vertices + heights[:, None] * vertex_normals(fine))
