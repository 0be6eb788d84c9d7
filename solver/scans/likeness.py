"""A template's shapes fitted roughly to a scan: who it is like, and with which expression.

    min over c, similarity of  sum_i w_i (n_i . (x_i(c) - q_i))^2 / s^2  +  |c / sigma|^2

with closest points q_i of the scan. A quick look, not a registration: a few thousand points, no
free form. Persons and expressions are fitted together, as nothing is known of the scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from solver.anatomy.template import Template
from solver.normals import vertex_normals
from solver.scans.pose import Pose
from solver.scans.sample import Samples
from solver.surface import Floats, Ints, Surface
from solver.triangles import vertex_areas

IDENTITIES = 30
EXPRESSION_SD = 0.35
STRONGEST = 1.2
REACHES_MM = (10.0, 8.0, 6.0, 5.0, *(4.0,) * 5, *(3.0,) * 5)
NOISE_SHARE = 0.25
INDEPENDENT = 0.05
"""Neighbouring distances go together: so many of them count as one observation."""
FACING = 0.6
IGNORED = ("eyeLook", "Pupil", "tongue")


@dataclass(frozen=True)
class Likeness:
    """The fitted template: its whole ``skin`` (n, 3) in mm in its own frame, the scan's pose."""

    skin: Floats
    pose: Pose


def fit_likeness(scan: Samples, pose: Pose, template: Template, face: Surface) -> Likeness:
    """Fit the template's shapes to a scan from a good ``pose``.

    ``face`` is the part of the skin that is fitted, in the template's numbers. A template without
    shapes is returned as it is, in that pose.
    """
    skin, shapes = template.skin.vertices, template.shapes
    if shapes is None:
        return Likeness(skin, pose)
    numbers, faces = np.unique(face.faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    chosen = [
        number
        for number, name in enumerate(shapes.expression_names)
        if not name.startswith(IGNORED)
    ]
    basis = np.concatenate([shapes.identity[:IDENTITIES], shapes.expressions[chosen]])
    people = min(IDENTITIES, len(shapes.identity))
    precision = np.full(len(basis), EXPRESSION_SD**-2)
    precision[:people] = 1.0
    weights, found = _fit(scan, pose, skin[numbers], faces, basis[:, numbers], precision, people)
    return Likeness(skin + np.tensordot(weights, basis, 1), found)


def _fit(
    scan: Samples,
    pose: Pose,
    rest: Floats,
    faces: Ints,
    basis: NDArray[np.float32],
    precision: Floats,
    people: int,
) -> tuple[Floats, Pose]:
    """Return the weights (k,) of ``basis`` (k, n, 3) and the pose, fitted together.

    The weights behind the first ``people`` are expressions, kept within [0, STRONGEST].
    """
    count = len(basis)
    weights = np.zeros(count)
    tree = KDTree(scan.points)
    area = vertex_areas(rest, faces)
    scale, rotation, translation = pose.scale, pose.rotation, pose.translation
    for reach in REACHES_MM:
        model = rest + np.tensordot(weights, basis, 1)
        normals = vertex_normals(Surface(model, faces))
        gap, near = tree.query((model - translation) @ rotation / scale)
        matched = scale * scan.points[near] @ rotation.T + translation
        facing = np.abs((scan.normals[near] @ rotation.T * normals).sum(axis=1))
        error = ((matched - model) * normals).sum(axis=1)
        trust = area / area.mean() * np.clip(1 - (gap * scale / reach) ** 2, 0, 1) ** 2
        trust *= (facing > FACING) * INDEPENDENT / (NOISE_SHARE * reach) ** 2
        centre = matched.mean(axis=0)
        p = matched - centre
        shape_rows = np.einsum("knd,nd->nk", basis, normals)
        motion_rows = [np.cross(p, normals), normals, (p * normals).sum(axis=1)[:, None]]
        rows = np.hstack([shape_rows, *(-part for part in motion_rows)])
        normal = rows.T @ (trust[:, None] * rows) + 1e-9 * np.eye(rows.shape[1])
        normal[range(count), range(count)] += precision
        step = np.linalg.solve(normal, rows.T @ (trust * (error + shape_rows @ weights)))
        weights = step[:count]
        weights[people:] = np.clip(weights[people:], 0.0, STRONGEST)
        turn = Rotation.from_rotvec(step[count : count + 3]).as_matrix()
        growth = float(np.clip(1 + step[-1], 0.95, 1.05))
        translation = growth * turn @ (translation - centre) + centre + step[count + 3 : -1]
        rotation, scale = turn @ rotation, growth * scale
    return weights, Pose(scale, rotation, translation, pose.residual_mm, pose.coverage)
