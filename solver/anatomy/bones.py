"""Bones: wraps as a boundary of the flesh, normals, the frame of the jaw, and where flesh glides.

A wrap is one smooth watertight surface around many bones. Raw ones have sutures, thin orbital
walls and foramina, which would fill with slivers of flesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import igl
import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from solver.anatomy.data import SIDES, LandmarkPath, missing_landmarks, read_table, split_cell
from solver.anatomy.embedding import at_nearest
from solver.anatomy.muscle_weights import end_vertices
from solver.anatomy.template import Muscle, Template
from solver.mechanics.terms import SlidingPlanes, no_planes, planes
from solver.model import JawFrame, SubjectModel, name_words
from solver.surface import (
    Floats,
    Ints,
    Surface,
    distance_to_path,
    inside,
    unit_rows,
    vertex_normals,
)

Volume = np.ndarray


@dataclass(frozen=True)
class BoneOptions:
    """Fineness of bone wraps, the room that they leave for flesh, and where flesh is held."""

    voxel_mm: float = 1.25
    joint_gap_mm: float = 1.5  # room for flesh between mandible and cranium
    skin_gap_mm: float = 2.4  # room for flesh between bone and skin
    # Radius of the morphological closing: sutures and foramina are narrower than twice that.
    closing_mm: float = 3.8
    faces: int = 6000  # of each wrap, after decimation
    smoothing_voxels: float = 1.0  # deviation of the Gaussian before marching cubes
    taubin_steps: int = 16  # of smoothing after it
    origin_mm: float = 5.0  # from a muscle's end: its attachment holds the flesh of a space


BONES = BoneOptions()


class VoxelGrid:
    """Cubes that cover the box ``lo`` to ``hi`` (3,) in mm."""

    def __init__(self, lo: Floats, hi: Floats) -> None:
        self.lo = lo
        self._side = BONES.voxel_mm
        self.shape = tuple(np.ceil((hi - lo) / self._side).astype(int))

    def shell(self, surface: Surface) -> Volume:
        """Return True for the voxels a surface passes through."""
        triangles = surface.vertices[surface.faces]
        box = (triangles.max(axis=1) > self.lo).all(axis=1)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces[box], process=False)
        count = int(6 * mesh.area / self._side**2)
        points, _ = trimesh.sample.sample_surface(mesh, count, seed=0)
        points = np.vstack([points, surface.vertices[np.unique(surface.faces)]])
        numbers = np.floor((points - self.lo) / self._side).astype(int)
        numbers = numbers[((numbers >= 0) & (numbers < self.shape)).all(axis=1)]
        volume = np.zeros(self.shape, dtype=bool)
        volume[tuple(numbers.T)] = True
        return volume

    def solid(self, surface: Surface) -> Volume:
        """Return True for the voxels inside a closed surface or on it."""
        volume = self.shell(surface)
        numbers = np.argwhere(~volume)
        centres = self.lo + (numbers + 0.5) * self._side
        lo = surface.vertices.min(axis=0)
        hi = surface.vertices.max(axis=0)
        near = ((centres > lo) & (centres < hi)).all(axis=1)
        volume[tuple(numbers[near][inside(surface, centres[near])].T)] = True
        return volume

    def surface(self, volume: Volume) -> Surface:
        """Return the smoothed, decimated boundary of the largest piece of ``volume``."""
        padded = np.pad(largest_piece(volume), 2).astype(float)
        field = ndimage.gaussian_filter(padded, BONES.smoothing_voxels)
        places = zip(self.lo, field.shape, strict=True)
        grid = [low + (np.arange(count) - 1.5) * self._side for low, count in places]
        steps = BONES.taubin_steps
        count = BONES.faces
        mesh = trimesh.Trimesh(*level_set(field, grid, 0.5), process=True)
        trimesh.smoothing.filter_taubin(mesh, iterations=steps)  # type: ignore[no-untyped-call]
        vertices, faces, _, _ = igl.qslim(np.asarray(mesh.vertices), np.asarray(mesh.faces), count)
        result = trimesh.Trimesh(vertices, faces, process=True)
        if result.volume < 0:
            result.invert()
        return Surface(np.asarray(result.vertices, float), np.asarray(result.faces, np.int64))

    def close(self, volume: Volume, radius_mm: float) -> Volume:
        """Return the closing of ``volume`` by a ball."""
        width = int(np.ceil(radius_mm / self._side)) + 1
        padded = np.pad(volume, width)
        grown = self.distance(padded) <= radius_mm
        closed = self.distance(~grown) > radius_mm
        return np.asarray((closed | padded)[(slice(width, -width),) * 3])

    def distance(self, volume: Volume) -> Floats:
        """Return the distance in mm of each voxel to the nearest of ``volume``."""
        return np.asarray(ndimage.distance_transform_edt(~volume, sampling=self._side))


def largest_piece(solid: Volume) -> Volume:
    """Return the largest connected piece of a solid."""
    pieces, _ = ndimage.label(solid)
    return np.asarray(pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:]))


def level_set(field: Floats, axes: list[Floats], level: float) -> tuple[Floats, Ints]:
    """Return vertices (v, 3) and faces (f, 3) of the surface where a field has a value.

    ``axes`` are the places of its samples; normals point to greater values.
    """
    # libigl counts x fastest.
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).transpose(2, 1, 0, 3).reshape(-1, 3)
    values = field.transpose(2, 1, 0).ravel()
    vertices, faces = igl.marching_cubes(values, points, *field.shape, level)[:2]
    return np.asarray(vertices), np.asarray(faces, np.int64)


def wrap_bones(
    cranium: Surface, mandible: Surface, skin: Surface, grid: VoxelGrid
) -> tuple[Surface, Surface]:
    """Return watertight wraps of cranium and mandible within the box of ``grid``.

    The cranium's wrap is solid: brain, orbits behind their rim, nose and sinuses are filled. It
    keeps ``joint_gap_mm`` of :data:`BONES` to the mandible, and both keep ``skin_gap_mm`` to
    ``skin``.
    """
    jaw = grid.solid(mandible)
    skull = grid.close(grid.shell(cranium), BONES.closing_mm)
    # Frontal slices: walls around brain, orbits and nose are rings there, the zygomatic arches are
    # not, so the temporal fossae stay open.
    for k in range(skull.shape[2]):
        skull[:, :, k] = ndimage.binary_fill_holes(skull[:, :, k])
    near_skin = grid.distance(grid.shell(skin)) < BONES.skin_gap_mm
    jaw &= ~near_skin
    skull &= ~near_skin & (grid.distance(jaw) > BONES.joint_gap_mm + BONES.voxel_mm)
    return grid.surface(ndimage.binary_opening(skull)), grid.surface(jaw)


def bone_normals(bone: Surface, points: Floats) -> Floats:
    """Return the bone's unit normals, (k, 3), where it is nearest to ``points`` (k, 3).

    Normals of vertices are blended over a triangle, so that neighbours slide alike.
    """
    return unit_rows(at_nearest(points, bone, vertex_normals(bone)))


def skull_planes(model: SubjectModel, rest: Floats, mu: Floats | float) -> SlidingPlanes:
    """Return the planes along the skull that a model's sliding vertices stay on.

    ``rest`` (p, 3) is where the vertices are on its bones, ``mu`` the flesh's, of all tets or each.
    """
    if not len(model.sliding):
        return no_planes()
    points = rest[model.sliding]
    normals = bone_normals(model.bones["cranium"], points)
    return replace(planes(model.rest, model.tets, model.sliding, normals, mu), points=points)


def jaw_frame(condyles: Floats) -> JawFrame:
    """Return the frame half way between the left and right condyle, ``condyles`` (2, 3) in mm.

    The first axis goes through the condyles to the subject's left, the second is the vertical made
    orthogonal to it, the third points forward.
    """
    lateral = unit_rows(condyles[0] - condyles[1])
    vertical = unit_rows(np.array([0.0, 1.0, 0.0]) - lateral[1] * lateral)
    axes = np.stack([lateral, vertical, np.cross(lateral, vertical)])
    return JawFrame(condyles.mean(axis=0), axes)


# Facial spaces: where flesh glides on the cranium, which holds it everywhere else. Their table has
# spaces and the retaining ligaments that part them. Each lies within ``radius_mm`` of a path of
# landmarks, brought onto the bone (:mod:`solver.anatomy.data`), or of the muscles that it is
# ``under``. Ligaments hold the flesh, and so do in a space the ``origins`` of muscles on its floor.


@dataclass(frozen=True)
class FacialSpace:
    """One line of the table, a space or a ligament; a template without its landmarks lacks it."""

    name: str
    is_ligament: bool
    path: LandmarkPath  # on each side
    under: tuple[str, ...]  # muscles, by what is in their names
    radius_mm: float
    origins: tuple[str, ...]  # muscles likewise


@cache
def facial_spaces() -> tuple[FacialSpace, ...]:
    """Return the table of spaces and ligaments."""
    return tuple(
        FacialSpace(
            row["name"],
            row["kind"] == "ligament",
            LandmarkPath.read(row["path"]),
            split_cell(row["under"]),
            float(row["radius_mm"]),
            split_cell(row["origins"]),
        )
        for row in read_table("facial_spaces")
    )


def gliding(head: Template, points: Floats) -> np.ndarray:
    """Return (k,) True where flesh glides, of ``points`` (k, 3) on a template's cranium, in mm."""
    glides, held = np.zeros((2, len(points)), dtype=bool)
    for space in facial_spaces():
        near = _within(head, space, points)
        if space.is_ligament:
            held |= near
        else:
            holding = _muscles(head, space.origins)
            origins = [end_vertices(each.surface, each.fibre)[0] for each in holding]
            glides |= near & ~(_distance(origins, points) < BONES.origin_mm)
    return np.asarray(glides & ~held)


def _within(head: Template, space: FacialSpace, points: Floats) -> np.ndarray:
    """Return (k,) True for points on the cranium that belong to a space or ligament."""
    surfaces = [muscle.surface.vertices for muscle in _muscles(head, space.under)]
    distance = _distance(surfaces, points)
    if space.path.points and not missing_landmarks([space.path], head.landmarks):
        inward = ~_faces_skin(head, points)
        for side in SIDES:
            on_skin = space.path.places(head.skin.vertices, head.landmarks, [side])
            path = at_nearest(on_skin, head.cranium, head.cranium.vertices)
            away = np.where(inward, np.inf, distance_to_path(points, path))
            distance = np.minimum(distance, away)
    return np.asarray(distance < space.radius_mm)


def _faces_skin(head: Template, points: Floats) -> np.ndarray:
    """Return (k,) True where the bone looks towards the face: not on the zygoma's back."""
    skin = head.skin.vertices[head.face_vertices]
    nearest = skin[cKDTree(skin).query(points)[1]]
    return np.asarray(((nearest - points) * bone_normals(head.cranium, points)).sum(axis=1) > 0.0)


def _distance(parts: Sequence[Floats], points: Floats) -> Floats:
    """Return how far ``points`` (k, 3) are from the nearest point of any part; inf without."""
    return np.asarray(cKDTree(np.vstack([np.empty((0, 3)), *parts])).query(points)[0])


def _muscles(head: Template, names: Sequence[str]) -> list[Muscle]:
    """Return the muscles that have one of ``names`` in theirs, of both sides."""
    plain = {muscle.name: " ".join(name_words(muscle.name.lower())) for muscle in head.muscles}
    return [muscle for muscle in head.muscles if any(name in plain[muscle.name] for name in names)]
