"""Filler: a volume that is injected along the path of a needle."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from solver.edits.edited import Edited
from solver.errors import InputError
from solver.mechanics.flesh import shape_gradients
from solver.model import SubjectModel
from solver.normals import vertex_normals
from solver.surface import Floats

MM3_PER_ML = 1000.0
RADIUS_MM = 2.5
LEAST_ROOM_MM3 = 1e-9
MOST = 1.35
"""Growth f of a tet at most: above, a bit of filler would be as large as the flesh around it."""


@dataclass(frozen=True)
class Filler:
    """So many ``ml`` along a ``path`` (k, 3) in mm, in the person's frame at rest.

    The flesh grows by f of F_p = f I with f^3 = 1 + alpha exp(-d^2 / (2 radius^2)), d being the
    distance to the path; alpha is such that the flesh, were it free, grew by the given volume.
    """

    path: Floats
    ml: float
    radius_mm: float = RADIUS_MM

    def __call__(self, before: Edited) -> Edited:
        """Return the person with it; raises ``scene.filler`` where there is no room for it."""
        model = before.model
        if not (self.ml > 0.0 and self.radius_mm > 0.0 and len(self.path)):
            raise InputError(
                "scene.filler", "a filler needs a path, and a volume and a radius above 0"
            )
        away = distance_to_path(model.rest[model.tets].mean(axis=1), self.path)
        shares = np.exp(-0.5 * (away / self.radius_mm) ** 2)
        volumes = shape_gradients(model.rest, model.tets)[1]
        room = float(volumes @ shares)
        if room < LEAST_ROOM_MM3:
            raise InputError(
                "scene.filler",
                f"there is no flesh within {self.radius_mm} mm of the path: lay it under the skin, "
                "or make the radius larger",
            )
        growth = np.cbrt(1.0 + self.ml * MM3_PER_ML / room * shares)
        if not growth.max() <= MOST:
            most = (MOST**3 - 1.0) * room / MM3_PER_ML / shares.max()
            raise InputError(
                "scene.filler",
                f"{self.ml} ml do not fit into the flesh within {self.radius_mm} mm of the path: "
                f"at most {most:.2f} ml do; make the path longer or the radius larger",
                found_ml=self.ml,
                expected_ml=round(most, 3),
            )
        return replace(before, growth=before.growth * growth)


def under_skin(model: SubjectModel, points: Floats, depths_mm: Floats) -> Floats:
    """Return points (k, 3) at depths (k,) under ``points`` (k, 3) of the face."""
    skin = model.skin.vertices[model.face]
    nearest = model.face[cKDTree(skin).query(points)[1]]
    return np.asarray(points - depths_mm[:, None] * vertex_normals(model.skin)[nearest])


def distance_to_path(points: Floats, path: Floats) -> Floats:
    """Return the distance (n,) of points (n, 3) to a polyline (k, 3); one point is one, too."""
    starts, ends = path[: max(len(path) - 1, 1)], path[min(1, len(path) - 1) :]
    nearest = np.full(len(points), np.inf)
    for start, end in zip(starts, ends, strict=True):
        along = end - start
        part = (points - start) @ along / max(float(along @ along), 1e-12)
        foot = start + np.clip(part, 0.0, 1.0)[:, None] * along
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    return nearest
