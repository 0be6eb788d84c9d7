"""The template of the ICT-FaceKit topology with the anatomy of BodyParts3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy import bodyparts3d, ict_facekit
from solver.anatomy.ict_anatomy import carry_anatomy
from solver.anatomy.ict_facekit import FaceKit
from solver.anatomy.ict_regions import LANDMARKS, named_regions
from solver.anatomy.template import Muscle, Template
from solver.anatomy.warp import similarity
from solver.surface import Floats, Ints, Surface

BACK_Z = 24.0
BOTTOM_Y = -95.5
PARTING = 0.4
PARTING_EXPRESSIONS = (
    "mouthLowerDown_L",
    "mouthLowerDown_R",
    "mouthUpperUp_L",
    "mouthUpperUp_R",
)
CONDYLE_MM = 10.0


def build_ict_template(anatomy_dir: Path, faces_dir: Path) -> Template:
    """Return the template of the ICT-FaceKit topology with the anatomy of BodyParts3D.

    Parameters
    ----------
    anatomy_dir
        ``index.csv`` and the PLY meshes it lists (mm); see :mod:`solver.anatomy.bodyparts3d`.
    faces_dir
        Holds ``ict_facekit.npz`` (cm); see :mod:`solver.anatomy.ict_facekit`.

    Raises
    ------
    InputError
        ``anatomy.*`` or ``faces.*`` where a folder lacks what is needed.
    """
    parts = bodyparts3d.read_parts(anatomy_dir)
    kit = ict_facekit.read_facekit(faces_dir)
    skin = kit.skin
    anatomy = carry_anatomy(parts, kit)
    skull = np.vstack([anatomy.cranium.vertices, anatomy.mandible.vertices])
    in_front = (skin.vertices[:, 2] > BACK_Z + 1) & (skin.vertices[:, 1] > BOTTOM_Y + 1)
    face = np.array(ict_facekit.NARROW_FACE)
    attached_mandible = _moving_with_jaw(kit)
    attached = np.arange(ict_facekit.FLESH.stop, len(skin.vertices))
    return Template(
        name="ict-bodyparts3d",
        version="1",
        source="ICT-FaceKit (USC ICT, MIT); BodyParts3D (DBCLS, CC BY 4.0)",
        skin=skin,
        flesh_faces=ict_facekit.faces_within(skin.faces, ict_facekit.FLESH),
        face_vertices=face[in_front[face]],
        attached_cranium=np.setdiff1d(attached, attached_mandible),
        attached_mandible=attached_mandible,
        parting=PARTING * np.sum([kit.deltas[name] for name in PARTING_EXPRESSIONS], axis=0),
        cranium=anatomy.cranium,
        mandible=anatomy.mandible,
        muscles=tuple(with_axis(name, surface, skull) for name, surface in anatomy.muscles.items()),
        condyles=_condyles(anatomy.jaw),
        back_z=BACK_Z,
        bottom_y=BOTTOM_Y,
        landmarks=dict(LANDMARKS),
        regions=named_regions(skin.vertices),
        shapes=ict_facekit.shape_basis(kit),
    )


def with_axis(name: str, surface: Surface, skull: Floats) -> Muscle:
    """Return a muscle whose axis is its longest extent, from the end nearer to ``skull`` (k, 3)."""
    centred = surface.vertices - surface.vertices.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = centred @ axis
    low, high = np.quantile(along, [0.1, 0.9])
    ends = [surface.vertices[along <= low], surface.vertices[along >= high]]
    tree = cKDTree(skull)
    ends.sort(key=lambda end: float(tree.query(end)[0].mean()))
    origin, insertion = (end.mean(axis=0) for end in ends)
    fibre = (insertion - origin) / np.linalg.norm(insertion - origin)
    return Muscle(name, surface, fibre, origin, insertion)


def _moving_with_jaw(kit: FaceKit) -> Ints:
    """Return the vertices of teeth, gums and tongue that follow the lower teeth in ``jawOpen``."""
    rest, moved = kit.skin.vertices, kit.skin.vertices + kit.deltas["jawOpen"]
    teeth = slice(ict_facekit.LOWER_TEETH.start, ict_facekit.LOWER_TEETH.stop)
    scale, rotation, shift = similarity(rest[teeth], moved[teeth])
    with_jaw = np.linalg.norm(moved - (scale * rest @ rotation.T + shift), axis=1)
    with_head = np.linalg.norm(moved - rest, axis=1)
    inner = np.arange(ict_facekit.GUMS_AND_TONGUE.start, ict_facekit.EYEBALLS.start)
    return np.asarray(inner[with_jaw[inner] < with_head[inner]])


def _condyles(mandible: Surface) -> Floats:
    """Return the centres (2, 3) of the left and right condyle: the highest point's surroundings."""
    centres = []
    for side in (1, -1):
        half = mandible.vertices[mandible.vertices[:, 0] * side > 0]
        back = half[half[:, 2] < np.quantile(half[:, 2], 0.3)]
        top = back[np.argmax(back[:, 1])]
        near = back[np.linalg.norm(back - top, axis=1) < CONDYLE_MM]
        centres.append((near.min(axis=0) + near.max(axis=0)) / 2)
    return np.array(centres)
