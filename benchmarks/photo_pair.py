"""A real pair of photographs of a face at rest whose scan is known, and what fits invent there.

A stereo rig's picture has both photographs side by side, and the scan's texture coordinates are the
projections into them, so that two linear fits are its cameras. A model is made of the scan itself:
the neutral face is the truth, and every weight that a fit finds is an error. A face that is
estimated from the photographs alone is compared with the scan as well.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

from benchmarks.documents import Figures
from solver.anatomy.build import build_subject_model
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.mechanics.boundary import JAW_FREEDOM
from solver.meshio.raw import mend, read_raw
from solver.model import SubjectModel
from solver.photo.camera import PinholeCamera
from solver.photo.detect import find_face
from solver.photo.expression import PhotoExpression, fit_expression, read_neutral
from solver.photo.identity import fit_identity
from solver.photo.photo import Photo
from solver.photo.read import read_photo
from solver.registration.detector import FaceDetector
from solver.registration.register import RegisteredFace, register
from solver.registration.topology import topology
from solver.similarity import fit_similarity, weighted_motion
from solver.surface import Floats
from solver.tracks.fit import ShapeFace

CORNER = re.compile(rb"(\d+)/(\d+)")
TRIM_PX = 1.5  # corners beyond are not of the photograph: they are left out of a second fit


@dataclass(frozen=True)
class Pair:
    """Both photographs with their landmarks and cameras, and the face that they are of."""

    photos: tuple[Photo, ...]
    camera_px: tuple[float, ...]  # median reprojection of the scan
    scan: RegisteredFace
    model: SubjectModel


def read_pair(path: Path, template: Template, edge_mm: float, detector: FaceDetector) -> Pair:
    """Return the pair of a textured OBJ; its picture is beside it by the same name."""
    raw, _ = mend(read_raw(path))
    scan = register(raw, topology(template))
    neutral = scan.skin.vertices
    model = build_subject_model(template, neutral, edge_mm=edge_mm, compartments=True)
    whole = read_photo(path.with_suffix(".jpg"))
    width, height = whole.size
    points, places = read_texture(path)
    places = places * (width, height)
    photos = []
    off = []
    for number, name in enumerate(("left", "right")):
        half = slice(number * width // 2, (number + 1) * width // 2)
        inside = (places[:, 0] >= half.start) & (places[:, 0] < half.stop)
        camera, px = fit_camera(points[inside], places[inside] - [half.start, 0.0])
        mm = scan.start.mm_per_unit
        world = replace(camera, translation=mm * camera.translation)
        placed = world.with_head(scan.motion.inverse())
        photo = Photo(name, whole.pixels[:, half], placed, is_placed=True)
        photos.append(replace(photo, landmarks=find_face(photo, detector).landmarks))
        off.append(px)
    return Pair(tuple(photos), tuple(off), scan, model)


def pair_figures(
    pair: Pair, template: Template, faces: Mapping[str, ShapeFace[Any]], points: SkinPoints
) -> Figures:
    """Return how far each system takes the face from its scan, and how near an estimate comes."""
    sets = {photo.name: [photo] for photo in pair.photos} | {"both": list(pair.photos)}
    found: dict[str, Figures] = {}
    for system, face in faces.items():
        for name, photos in sets.items():
            fitted = fit_expression(face, photos, points)
            found[f"{system} {name}"] = _off(pair, fitted)
        for still, photo in permutations(pair.photos):
            look = read_neutral(face, still, points)
            fitted = fit_expression(face, [photo], look.points)
            found[f"{system} {photo.name}, {still.name} as its neutral"] = _off(pair, fitted)
    estimates = {
        name: _estimate_off(pair, fit_identity(template, photos, points).neutral)
        for name, photos in sets.items()
    }
    estimates["mean face"] = _estimate_off(pair, template.skin.vertices)
    return {"camera_px": max(pair.camera_px), "fits": found, "estimates": estimates}


def _estimate_off(pair: Pair, skin: Floats) -> dict[str, float]:
    """Return the median distance to the scan of a face that is laid on it, as large and resized."""
    face = pair.model.face
    rest = pair.model.skin.vertices
    rigid = weighted_motion(skin[face], rest[face], np.ones(len(face)))
    resized = fit_similarity(skin[face], rest[face])
    return {
        "aligned_median_mm": float(np.median(_distances(pair, rigid(skin)))),
        "resized_median_mm": float(np.median(_distances(pair, resized(skin)))),
    }


def _off(pair: Pair, fitted: PhotoExpression[Any]) -> dict[str, float]:
    face = pair.model.face
    rest = pair.model.skin.vertices
    figures: dict[str, float] = {}
    for stage, fit in (("landmarks", fitted.landmarks), ("shading", fitted.fit)):
        skin = fit.point.skin
        still = weighted_motion(skin[face], rest[face], np.ones(len(face)))(skin)
        moved = np.linalg.norm(still[face] - rest[face], axis=1)
        figures[f"{stage}_mm"] = float(moved.mean())
        further = _distances(pair, still).mean() - _distances(pair, rest).mean()
        figures[f"{stage}_grown_mm"] = float(further)
        figures[f"{stage}_weights"] = float(fit.point.state.q[:-JAW_FREEDOM].sum())
    return figures


def _distances(pair: Pair, skin: Floats) -> Floats:
    """Return the distances to the scan, mm, of the face's vertices that it shows."""
    face = pair.model.face
    trust = pair.scan.trust
    seen = face[trust.covered[face]]
    back = pair.scan.motion.inverse()
    found = pair.scan.scan.closest(back(skin[seen]))
    return np.asarray(found.distance[~found.at_edge])


def read_texture(path: Path) -> tuple[Floats, Floats]:
    """Return points (n, 3) of an OBJ and where its picture has them (n, 2), shares from the top."""
    lines = path.read_bytes().splitlines()
    vertices = np.array([line.split()[1:4] for line in lines if line.startswith(b"v ")], float)
    texture = np.array([line.split()[1:3] for line in lines if line.startswith(b"vt ")], float)
    corners = {
        (int(v) - 1, int(vt) - 1)
        for line in lines
        if line.startswith(b"f ")
        for v, vt in CORNER.findall(line)
    }
    rows, marks = np.array(sorted(corners)).T
    return vertices[rows], texture[marks] * [1.0, -1.0] + [0.0, 1.0]


def fit_camera(points: Floats, pixels: Floats) -> tuple[PinholeCamera, float]:
    """Return the camera that sees points (n, 3) at pixels (n, 2), and its median error in px.

    The direct linear transform (Hartley and Zisserman 2003), its skew left out.
    """
    kept = np.ones(len(points), bool)
    camera = _linear_camera(points, pixels)
    away = np.zeros(0)
    for _ in range(2):
        away = np.linalg.norm(camera.project(points)[:, :2] - pixels, axis=1)
        kept = away < max(TRIM_PX, 3.0 * float(np.median(away)))
        camera = _linear_camera(points[kept], pixels[kept])
    return camera, float(np.median(away))


def _linear_camera(points: Floats, pixels: Floats) -> PinholeCamera:
    middle = points.mean(axis=0)
    size = points.std()
    centre = pixels.mean(axis=0)
    extent = pixels.std()
    homogeneous = np.column_stack([(points - middle) / size, np.ones(len(points))])
    u, v = ((pixels - centre) / extent).T[:, :, None]
    nothing = np.zeros_like(homogeneous)
    rows = np.vstack(
        [
            np.hstack([homogeneous, nothing, -u * homogeneous]),
            np.hstack([nothing, homogeneous, -v * homogeneous]),
        ]
    )
    matrix = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
    back = np.array([[extent, 0.0, centre[0]], [0.0, extent, centre[1]], [0.0, 0.0, 1.0]])
    into = np.vstack([np.column_stack([np.eye(3), -middle]) / size, [0.0, 0.0, 0.0, 1.0]])
    matrix = back @ matrix @ into
    matrix *= np.sign(np.linalg.det(matrix[:, :3])) / np.linalg.norm(matrix[2, :3])
    inner, rotation = scipy.linalg.rq(matrix[:, :3])
    signs = np.diag(np.sign(np.diag(inner)))
    inner = inner @ signs
    rotation = signs @ rotation
    shift = np.linalg.solve(inner, matrix[:, 3])
    return PinholeCamera(inner[[0, 1], [0, 1]], inner[:2, 2], rotation, shift)
