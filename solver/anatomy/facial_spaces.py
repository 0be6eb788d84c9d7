"""Facial spaces: where flesh glides on the cranium, which holds it everywhere else.

``facial_spaces.csv`` in ``solver/anatomy/data`` has the spaces and the retaining ligaments that
part them. Each lies within ``radius_mm`` of a path of landmarks, brought onto the bone
(:mod:`solver.anatomy.data`), or of the muscles that it is ``under``. Ligaments hold the
flesh, and so do in a space the ``origins`` of muscles on its floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.bones import bone_normals
from solver.anatomy.data import SIDES, LandmarkPath, missing_landmarks, read_table, split_cell
from solver.anatomy.embedding import at_nearest
from solver.anatomy.muscle_weights import end_vertices
from solver.anatomy.template import Muscle, Template
from solver.model import name_words
from solver.surface import Floats, distance_to_path


@dataclass(frozen=True)
class FacialSpace:
    """One line of the table, a space or a ligament; a template without its landmarks lacks it."""

    name: str
    is_ligament: bool
    path: LandmarkPath  # on each side
    under: tuple[str, ...]  # muscles, by what is in their names
    radius_mm: float
    origins: tuple[str, ...]  # muscles likewise


@dataclass(frozen=True)
class SpaceOptions:
    """Share of the bone that an attachment takes."""

    origin_mm: float = 5.0  # from a muscle's end


SPACES = SpaceOptions()


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
            glides |= near & ~(_distance(origins, points) < SPACES.origin_mm)
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
