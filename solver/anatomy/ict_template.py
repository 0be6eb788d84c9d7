"""The template of the ICT-FaceKit topology with the anatomy of BodyParts3D."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from solver.anatomy import bodyparts3d, ict_facekit
from solver.anatomy.contact_regions import contact_regions
from solver.anatomy.ict_anatomy import carry_anatomy
from solver.anatomy.ict_depths import both_sides, depth_table
from solver.anatomy.ict_facekit import FaceKit
from solver.anatomy.ict_regions import LANDMARKS, named_regions
from solver.anatomy.lip_sides import lips_apart
from solver.anatomy.muscle_axes import bodyparts3d_muscle
from solver.anatomy.template import Template
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
        BodyParts3D, in one of the forms that :mod:`solver.anatomy.bodyparts3d` reads.
    faces_dir
        ICT-FaceKit, in one of the forms that :mod:`solver.anatomy.ict_facekit` reads.

    Raises
    ------
    InputError
        ``anatomy.*``, ``faces.*`` or ``download.*`` where a folder lacks what is needed.
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
    depth_landmarks, depths = depth_table(skin.vertices)
    landmarks = {**depth_landmarks, **both_sides(LANDMARKS, skin.vertices)}
    flesh_faces = ict_facekit.faces_within(skin.faces, ict_facekit.FLESH)
    flesh = Surface(skin.vertices, skin.faces[flesh_faces])
    sides = lips_apart(flesh, landmarks)
    touching = contact_regions(flesh, sides, _teeth_and_eyes(skin.vertices), landmarks)
    return Template(
        name="ict-bodyparts3d",
        version="1",
        source="ICT-FaceKit (USC ICT, MIT); BodyParts3D (DBCLS, CC BY 4.0)",
        skin=skin,
        flesh_faces=flesh_faces,
        face_vertices=face[in_front[face]],
        attached_cranium=np.setdiff1d(attached, attached_mandible),
        attached_mandible=attached_mandible,
        parting=PARTING * np.sum([kit.deltas[name] for name in PARTING_EXPRESSIONS], axis=0),
        cranium=anatomy.cranium,
        mandible=anatomy.mandible,
        muscles=tuple(
            bodyparts3d_muscle(name, surface, skull) for name, surface in anatomy.muscles.items()
        ),
        condyles=_condyles(anatomy.jaw),
        back_z=BACK_Z,
        bottom_y=BOTTOM_Y,
        landmarks=landmarks,
        regions={**named_regions(skin.vertices, sides), **touching},
        shapes=ict_facekit.shape_basis(kit),
        licence="MIT (ICT-FaceKit) and CC BY 4.0 (BodyParts3D)",
        depths=depths,
    )


def _teeth_and_eyes(skin: Floats) -> dict[str, Ints]:
    eyeballs = np.array(ict_facekit.EYEBALLS)
    return {
        "upper_teeth": np.array(ict_facekit.UPPER_TEETH),
        "lower_teeth": np.array(ict_facekit.LOWER_TEETH),
        "left_eyeball": eyeballs[skin[eyeballs, 0] > 0],
        "right_eyeball": eyeballs[skin[eyeballs, 0] < 0],
    }


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
