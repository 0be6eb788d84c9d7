"""The neck of BodyParts3D's man: joints and attachments off his own meshes, the rest built-in.

Joints are where his discs are, that of C1 at the dens' height and the head's on top of the atlas.
The built-in neck is brought onto them by a similarity; then each muscle that he has a mesh of
(``data/bodyparts3d.csv``) gets its ends from there: the means of the last twelfth of the mesh along
its longest axis. Bellies with several insertions so end in their middle, as the built-in ones do.
Lengths of fibres and tendons go with the paths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from solver.anatomy.data import read_table
from solver.neck.anatomy import Neck, NeckMuscle
from solver.neck.builtin import DATA, builtin_neck
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats
from solver.templates.bodyparts3d import AnatomicalPart, part_surface

END = 1.0 / 12.0  # of a mesh's length, that is its end
DISCS = (
    "seventh cervical vertebra",
    "sixth cervical vertebra",
    "fifth cervical vertebra",
    "fourth cervical vertebra",
    "third cervical vertebra",
    "axis",
)
# points beside the head's joint, mm: the joints alone lie on a line
BESIDE = np.array([[50.0, 0.0, 0.0], [-50.0, 0.0, 0.0]])


@dataclass(frozen=True)
class ReadNeck:
    """A man's neck, and how far the built-in one, put onto it, is from it."""

    neck: Neck
    placed: Similarity  # of the built-in neck
    joints_mm: Floats  # (8,) between the joints
    ends_mm: Mapping[str, Floats]  # (2,) or (1,) of a muscle: between attachments

    @property
    def median_mm(self) -> float:
        """Return the median distance of attachments."""
        return float(np.median(np.concatenate(list(self.ends_mm.values()))))


def read_neck(parts: Mapping[str, AnatomicalPart]) -> ReadNeck:
    """Return the neck of BodyParts3D's parts, in their axes (x to the left, y up, z forward), mm.

    Raises :class:`InputError` (``anatomy.part``) where a vertebra or disc is missing; muscles that
    are missing stay built-in.
    """
    joints = _joints(parts)
    own = builtin_neck()
    source = np.vstack([own.centres, own.centres[-1] + BESIDE])
    placed = fit_similarity(source, np.vstack([joints, joints[-1] + BESIDE]))
    neck = own.moved(placed)
    off = np.linalg.norm(neck.centres - joints, axis=1)
    table = {row["muscle"]: row for row in read_table("bodyparts3d", DATA)}
    muscles = []
    ends = {}
    for muscle in neck.muscles:
        name = muscle.name[:-2]
        side = {"l": "left", "r": "right"}[muscle.name[-1]]
        row = table.get(name)
        part = "" if row is None else row["part"].format(side=side)
        if row is None or part not in parts:
            muscles.append(muscle)
            continue
        which = [-1] if row["ends"] == "top" else [0, -1]
        found = _ends(part_surface(dict(parts), part).vertices)[which]
        ends[muscle.name] = np.linalg.norm(muscle.points[which] - found, axis=1)
        muscles.append(_with_ends(muscle, which, found))
    read = replace(neck, centres=joints, muscles=tuple(muscles), source="BodyParts3D")
    return ReadNeck(read, placed, off, ends)


def _joints(parts: Mapping[str, AnatomicalPart]) -> Floats:
    """Return the centres of the joints (8, 3), of C7 ... head."""
    discs = [
        part_surface(dict(parts), f"intervertebral disk of {name}").vertices.mean(axis=0)
        for name in DISCS
    ]
    atlas, axis = (part_surface(dict(parts), name).vertices for name in ("atlas", "axis"))
    dens = axis[axis[:, 1] > np.quantile(axis[:, 1], 0.9)].mean(axis=0)
    sides = atlas[np.abs(atlas[:, 0] - atlas[:, 0].mean()) < np.ptp(atlas[:, 0]) / 4.0]
    top = sides[sides[:, 1] > np.quantile(sides[:, 1], 0.9)].mean(axis=0)
    turning = np.array([dens[0], atlas[:, 1].mean(), dens[2]])
    centres = np.array([*discs, turning, top])
    centres[:, 0] = np.median(centres[:, 0])
    return centres


def _ends(points: Floats) -> Floats:
    """Return the lower and the upper end (2, 3) of a muscle's mesh."""
    middle = points.mean(axis=0)
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    along = (points - middle) @ (axis if axis[1] > 0.0 else -axis)
    low = along.min() + END * np.ptp(along)
    high = along.max() - END * np.ptp(along)
    return np.array([points[along <= low].mean(axis=0), points[along >= high].mean(axis=0)])


def _with_ends(muscle: NeckMuscle, which: list[int], ends: Floats) -> NeckMuscle:
    points = muscle.points.copy()
    points[which] = ends
    grown = replace(muscle, points=points, source="BodyParts3D (CC BY 4.0)")
    factor = grown.length / muscle.length
    return replace(grown, fibre=muscle.fibre * factor, tendon=muscle.tendon * factor)
