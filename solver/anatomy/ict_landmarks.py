"""Corresponding points of BodyParts3D and the ICT-FaceKit head, and the soft-tissue depths."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from importlib import resources

import numpy as np
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from solver.anatomy import bodyparts3d, ict_facekit
from solver.anatomy.bodyparts3d import Part
from solver.anatomy.depth_warp import Landmarks
from solver.anatomy.ict_facekit import FaceKit
from solver.surface import Floats, Ints, Surface
from solver.triangles import adjacency

CROWN_MM = 8.0
"""Height of the part of a tooth whose middle is the landmark."""
RANGE_SD = 2.0
"""Depths may differ from the mean by this many standard deviations."""
DEPTH_SPREAD_MM = 18.0
"""How far around a depth landmark its depth is wanted."""


@dataclass(frozen=True)
class DepthTable:
    """Soft-tissue depths at points (k, 3) of the skull, mean and standard deviation in mm."""

    points: Floats
    mean: Floats
    deviation: Floats

    def bounds(self, points: Floats, least_mm: float) -> tuple[Floats, Floats]:
        """Return least and greatest depths (n,); no greatest one far from every landmark."""
        weights = np.exp(-((cdist(points, self.points) / DEPTH_SPREAD_MM) ** 2) / 2)
        total = weights.sum(axis=1) + 1e-12
        mean = weights @ self.mean / total
        deviation = weights @ self.deviation / total
        near = total > np.exp(-2.0)
        least = np.where(near, mean - RANGE_SD * deviation, 0.0)
        greatest = np.where(near, mean + RANGE_SD * deviation, np.inf)
        return np.maximum(least, least_mm), greatest


def teeth_and_eyes(parts: dict[str, Part], kit: FaceKit) -> Landmarks:
    """Return the middles of 28 tooth crowns and the centres of the eyeballs in both models."""
    source, target = [], []
    skin = kit.skin
    for jaw, numbers in (("upper", ict_facekit.UPPER_TEETH), ("lower", ict_facekit.LOWER_TEETH)):
        # 16 teeth a jaw from left to right; BodyParts3D has no wisdom teeth.
        teeth = _components(skin.faces, numbers)[1:-1]
        for tooth, name in zip(teeth, ict_facekit.TEETH_NAMES, strict=True):
            crown = bodyparts3d.named(parts, name.format(jaw=jaw)).vertices
            source.append(_crown(crown, jaw))
            target.append(_crown(skin.vertices[tooth], jaw))
    eyes = bodyparts3d.named(parts, "eyeball").vertices
    balls = skin.vertices[ict_facekit.EYEBALLS.start : ict_facekit.EYEBALLS.stop]
    for side in (1, -1):
        source.append(_sphere_centre(eyes[eyes[:, 0] * side > 0]))
        target.append(_sphere_centre(balls[balls[:, 0] * side > 0]))
    return Landmarks(np.array(source), np.array(target))


def _components(faces: Ints, numbers: range) -> list[Ints]:
    own = faces[ict_facekit.faces_within(faces, numbers)] - numbers.start
    count, labels = connected_components(adjacency(own, len(numbers)), directed=False)
    parts = [np.flatnonzero(labels == number) + numbers.start for number in range(count)]
    return sorted(parts, key=lambda part: int(part[0]))


def _crown(tooth: Floats, jaw: str) -> Floats:
    height = tooth[:, 1] if jaw == "upper" else -tooth[:, 1]
    crown = tooth[height < height.min() + CROWN_MM]
    return np.asarray((crown.min(axis=0) + crown.max(axis=0)) / 2)


def _sphere_centre(points: Floats) -> Floats:
    # |p|^2 = 2 p.c + (r^2 - |c|^2), linear in the centre c and the bracket.
    system = np.column_stack([2 * points, np.ones(len(points))])
    return np.asarray(np.linalg.lstsq(system, np.sum(points**2, axis=1), rcond=None)[0][:3])


def depth_landmarks(skin: Surface) -> tuple[Landmarks, Landmarks, DepthTable]:
    """Return skull anchors, muscle anchors and depths from ``bodyparts3d_landmarks.csv``.

    Rows of kind ``anchor`` fix a point of the skull at its mean depth under a skin vertex, those of
    kind ``muscle`` a point of a muscle; those of kind ``depth`` only say how deep the bone lies.
    """
    normals = trimesh.Trimesh(skin.vertices, skin.faces, process=False).vertex_normals
    anchors: dict[str, list[tuple[Floats, Floats]]] = {"anchor": [], "muscle": [], "depth": []}
    depths = []
    path = resources.files("solver.anatomy.data").joinpath("bodyparts3d_landmarks.csv")
    with path.open() as stream:
        for row in csv.DictReader(stream):
            point = np.array([float(row[axis]) for axis in "xyz"])
            vertex, depth = int(row["skin_vertex"]), float(row["depth_mm"])
            under = skin.vertices[vertex] - depth * normals[vertex]
            pairs = [(point, under)]
            if row["side"] == "both":
                pairs.append((bodyparts3d.reflected(point), under * [-1, 1, 1]))
            anchors[row["kind"]] += pairs
            if row["kind"] != "muscle":
                depths += [(*source, depth, float(row["sd_mm"])) for source, _ in pairs]
    table = np.array(depths)
    bone, muscle = (
        Landmarks(*np.array(anchors[kind]).transpose(1, 0, 2)) for kind in ("anchor", "muscle")
    )
    return bone, muscle, DepthTable(table[:, :3], table[:, 3], table[:, 4])
