"""Registered scans as targets: the distance to their points, or to their surface."""

from __future__ import annotations

from typing import Literal

import numpy as np

from solver.fitting.objective import Target
from solver.model import SubjectModel
from solver.normals import vertex_normals
from solver.scans.registered import RegisteredScan
from solver.surface import Floats, Ints, Surface

Distance = Literal["point", "plane"]
"""What counts: the whole distance to a scan's vertex, or its part along the scan's normal there.

Along the surface a plane lets the skin slide: registration is least certain in that direction.
"""


class Targets:
    """Makes targets of the scans of one person."""

    def __init__(self, model: SubjectModel, distance: Distance) -> None:
        self._face, self._distance = model.face, distance
        self._triangles = _face_triangles(model)

    def of_scan(self, scan: RegisteredScan) -> Target:
        """Return the target of a scan of the whole topology."""
        return self.of_points(scan.vertices[self._face], scan.confidence[self._face])

    def of_points(self, points: Floats, confidence: Floats) -> Target:
        """Return the target of the face's points (k, 3), NaN where nothing was seen."""
        if self._distance == "point":
            return Target.from_points(points, confidence)
        return Target.from_points(points, confidence, _normals(points, self._triangles))


def _face_triangles(model: SubjectModel) -> Ints:
    """Return the skin's triangles within the face, (f, 3), by numbers of the face's points."""
    number = np.full(len(model.skin.vertices), -1)
    number[model.face] = np.arange(len(model.face))
    triangles = number[model.skin.faces]
    return np.asarray(triangles[(triangles >= 0).all(axis=1)])


def _normals(points: Floats, triangles: Ints) -> Floats:
    """Return the unit normals (k, 3) of what is seen; NaN at a point of no triangle."""
    whole = triangles[np.isfinite(points[triangles]).all(axis=(1, 2))]
    normals = vertex_normals(Surface(np.nan_to_num(points), whole))
    normals[np.bincount(whole.ravel(), minlength=len(points)) == 0] = np.nan
    return normals
