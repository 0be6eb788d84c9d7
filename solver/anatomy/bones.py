"""Bone wraps: one smooth watertight surface around many bones, as a boundary of the flesh.

Raw bones have sutures, thin orbital walls and foramina, which would fill with slivers of flesh.
"""

from __future__ import annotations

import igl
import numpy as np
import trimesh
from scipy import ndimage

from solver.surface import Floats, Surface

VOXEL_MM = 1.25
JOINT_GAP_MM = 1.5
"""Room for flesh between mandible and cranium."""
SKIN_GAP_MM = 2.4
"""Room for flesh between bone and skin."""
CLOSING_MM = 3.8
WRAP_FACES = 6000
SMOOTHING_VOXELS = 1.0
TAUBIN_STEPS = 16

Volume = np.ndarray


class VoxelGrid:
    """Cubes of :data:`VOXEL_MM` that cover the box ``lo`` to ``hi`` (3,) in mm."""

    def __init__(self, lo: Floats, hi: Floats) -> None:
        self.lo = lo
        self.shape = tuple(np.ceil((hi - lo) / VOXEL_MM).astype(int))

    def shell(self, surface: Surface) -> Volume:
        """Return True for the voxels a surface passes through."""
        triangles = surface.vertices[surface.faces]
        box = (triangles.max(axis=1) > self.lo).all(axis=1)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces[box], process=False)
        count = int(6 * mesh.area / VOXEL_MM**2)
        points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
        points = np.vstack([points, surface.vertices[np.unique(surface.faces)]])
        numbers = np.floor((points - self.lo) / VOXEL_MM).astype(int)
        numbers = numbers[((numbers >= 0) & (numbers < self.shape)).all(axis=1)]
        volume = np.zeros(self.shape, dtype=bool)
        volume[tuple(numbers.T)] = True
        return volume

    def solid(self, surface: Surface) -> Volume:
        """Return True for the voxels inside a closed surface or on it."""
        volume = self.shell(surface)
        numbers = np.argwhere(~volume)
        centres = self.lo + (numbers + 0.5) * VOXEL_MM
        lo, hi = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
        near = ((centres > lo) & (centres < hi)).all(axis=1)
        winding = igl.fast_winding_number(surface.vertices, surface.faces, centres[near])
        volume[tuple(numbers[near][np.asarray(winding) > 0.5].T)] = True
        return volume

    def surface(self, volume: Volume) -> Surface:
        """Return the smoothed, decimated boundary of the largest piece of ``volume``."""
        labels, _ = ndimage.label(volume)
        largest = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
        padded = np.pad(largest, 2).astype(float)
        field = ndimage.gaussian_filter(padded, SMOOTHING_VOXELS)
        # libigl counts x fastest.
        nx, ny, nz = field.shape
        steps = np.meshgrid(*[np.arange(k) for k in (nz, ny, nx)], indexing="ij")
        points = np.column_stack([steps[2].ravel(), steps[1].ravel(), steps[0].ravel()])
        points = self.lo + (points - 1.5) * VOXEL_MM
        values = field.transpose(2, 1, 0).ravel()
        vertices, faces = igl.marching_cubes(values, points, nx, ny, nz, 0.5)[:2]
        return _simplified(Surface(np.asarray(vertices), np.asarray(faces).astype(np.int64)))


def _simplified(surface: Surface) -> Surface:
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    trimesh.smoothing.filter_taubin(mesh, iterations=TAUBIN_STEPS)  # type: ignore[no-untyped-call]
    vertices, faces, _, _ = igl.qslim(np.asarray(mesh.vertices), np.asarray(mesh.faces), WRAP_FACES)
    result = trimesh.Trimesh(vertices, faces, process=True)
    if result.volume < 0:
        result.invert()
    return Surface(np.asarray(result.vertices, float), np.asarray(result.faces, np.int64))


def wrap_bones(
    cranium: Surface, mandible: Surface, skin: Surface, grid: VoxelGrid
) -> tuple[Surface, Surface]:
    """Return watertight wraps of cranium and mandible within the box of ``grid``.

    The cranium's wrap is solid: brain, orbits behind their rim, nose and sinuses are filled. It
    keeps :data:`JOINT_GAP_MM` to the mandible, and both keep :data:`SKIN_GAP_MM` to ``skin``.
    """
    jaw = grid.solid(mandible)
    skull = _closed(grid.shell(cranium), CLOSING_MM)
    # Frontal slices: walls around brain, orbits and nose are rings there, the zygomatic arches are
    # not, so the temporal fossae stay open.
    for k in range(skull.shape[2]):
        skull[:, :, k] = ndimage.binary_fill_holes(skull[:, :, k])
    near_skin = _distance(grid.shell(skin)) < SKIN_GAP_MM
    jaw &= ~near_skin
    skull &= ~near_skin & (_distance(jaw) > JOINT_GAP_MM + VOXEL_MM)
    return grid.surface(ndimage.binary_opening(skull)), grid.surface(jaw)


def _closed(volume: Volume, radius_mm: float) -> Volume:
    width = int(np.ceil(radius_mm / VOXEL_MM)) + 1
    padded = np.pad(volume, width)
    grown = _distance(padded) <= radius_mm
    closed = ndimage.distance_transform_edt(grown, sampling=VOXEL_MM) > radius_mm
    inner = tuple(slice(width, -width) for _ in range(3))
    return np.asarray((closed | padded)[inner])


def _distance(volume: Volume) -> Floats:
    return np.asarray(ndimage.distance_transform_edt(~volume, sampling=VOXEL_MM))
