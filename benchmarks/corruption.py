"""Raw scans with a known answer: what a scanner would make of a registered surface."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from scipy.spatial.transform import Rotation

from solver.drawing.render import Camera, look
from solver.meshio.raw import RawScan
from solver.surface import Floats, Ints, Surface

CAMERAS = [
    (yaw, pitch)
    for yaw in np.radians([0, 25, -25, 50, -50, 80, -80])
    for pitch in (-0.35, 0.1, 0.5)
]
CAMERA_PIXELS = 900
HOLE_RADII_MM = (5.0, 18.0)
BEHIND_MM = 150.0
"""A scan reaches this far back from the nose."""


@dataclass(frozen=True)
class Corruption:
    """Faults put into a scan: ``noise_mm``, ``hole_share``, grid ``cell_mm``, ``unit`` in mm."""

    noise_mm: float = 0.3
    hole_share: float = 0.2
    cell_mm: float = 1.6
    unit_mm: float = 1.0


def corrupted(surface: Surface, seed: int, how: Corruption) -> RawScan:
    """Return a raw scan of ``surface`` (a whole head in mm), the same for the same seed.

    What cameras around the face see of it is taken, with the eyes and what an open mouth shows.
    Round holes are cut; the rest is resampled on a randomly turned grid, which gives it another
    topology; every vertex gets noise; the whole is turned and moved at random and written in
    another unit.
    """
    rng = np.random.default_rng(seed)
    seen = _compact(surface.vertices, surface.faces[_seen(surface)])
    vertices, faces = igl.upsample(seen.vertices, seen.faces)
    kept = vertices[:, 2] > vertices[:, 2].max() - BEHIND_MM
    kept &= ~_holes(vertices, kept, how.hole_share, rng)
    fine = _compact(vertices, faces[kept[faces].all(axis=1)])
    scan = _resampled(fine, how.cell_mm, rng)
    points = scan.vertices + how.noise_mm * rng.standard_normal(scan.vertices.shape)
    turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    points = (points @ turn.T + rng.uniform(-300, 300, 3)) / how.unit_mm
    return RawScan(
        file=f"corrupted-{seed}.ply",
        vertices=points,
        faces=scan.faces,
        normals=None,
        colours=None,
        mm_per_unit=None,
        format="ply",
        suffix_format="ply",
    )


def _seen(surface: Surface) -> np.ndarray:
    low = surface.vertices.min(axis=0)
    high = surface.vertices.max(axis=0)
    seen = np.zeros(len(surface.faces), dtype=bool)
    for yaw, pitch in CAMERAS:
        camera = Camera((low + high) / 2, 1.2 * float((high - low).max()), yaw, pitch)
        triangle = look(camera, surface, CAMERA_PIXELS, CAMERA_PIXELS).triangle
        seen[np.unique(triangle[triangle >= 0])] = True
    return seen


def _holes(
    vertices: Floats, kept: np.ndarray, share: float, rng: np.random.Generator
) -> np.ndarray:
    holes = np.zeros(len(vertices), dtype=bool)
    while (holes & kept).sum() < share * kept.sum():
        centre = vertices[rng.integers(len(vertices))]
        holes |= np.linalg.norm(vertices - centre, axis=1) < rng.uniform(*HOLE_RADII_MM)
    return holes


def _resampled(surface: Surface, cell_mm: float, rng: np.random.Generator) -> Surface:
    """Keep one vertex in each cell of a turned grid, and the triangles between different cells."""
    turn = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    cells = np.floor(surface.vertices @ turn.T / cell_mm).astype(np.int64)
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return _compact(surface.vertices[first], number.reshape(-1)[surface.faces])


def _compact(vertices: Floats, faces: Ints) -> Surface:
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, single = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    used, numbers = np.unique(faces[single], return_inverse=True)
    return Surface(vertices[used], numbers.reshape(-1, 3).astype(np.int64))
