"""The template of the ICT-FaceKit topology with the anatomy of BodyParts3D: landmarks and regions.

The anatomy itself is carried into the head by :mod:`solver.templates.ict_anatomy`.
"""

from __future__ import annotations

import csv
from importlib import resources
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, lips_apart
from solver.anatomy.muscle_weights import bodyparts3d_muscle
from solver.anatomy.template import Depth, Template
from solver.similarity import fit_similarity
from solver.surface import Floats, Ints, Surface
from solver.templates import bodyparts3d, ict_facekit
from solver.templates.ict_anatomy import carry_anatomy
from solver.templates.ict_facekit import FaceKit

# Landmarks on both sides of the ICT-FaceKit face, and the soft-tissue depths at them.


SOURCE = (
    "Means after Stephan and Simpson (2008) and Rhine and Moore (1982), see sources.csv; entered "
    "by hand, not yet checked against the printed tables"
)


def both_sides(landmarks: dict[str, int], skin: Floats) -> dict[str, int]:
    """Return landmarks with a right one (``name_r``) for every left one: the face is symmetric."""
    left = {name: vertex for name, vertex in landmarks.items() if name.endswith("_l")}
    mirrored = skin[list(left.values())] * [-1, 1, 1]
    right = cKDTree(skin).query(mirrored)[1]
    names = (f"{name.removesuffix('_l')}_r" for name in left)
    return {**landmarks, **{name: int(vertex) for name, vertex in zip(names, right, strict=True)}}


def depth_table(skin: Floats) -> tuple[dict[str, int], tuple[Depth, ...]]:
    """Return the landmarks of the depth table in a skin (n, 3), and the depths at them."""
    path = resources.files("solver.anatomy.data").joinpath("bodyparts3d_landmarks.csv")
    with path.open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["kind"] != "muscle"]
    landmarks, depths = {}, []
    for row in rows:
        name = row["name"].replace(" ", "_")
        paired = row["side"] == "both"
        landmarks[f"{name}_l" if paired else name] = int(row["skin_vertex"])
        for landmark in (f"{name}_l", f"{name}_r") if paired else (name,):
            depths.append(
                Depth(landmark, row["bone"], float(row["depth_mm"]), float(row["sd_mm"]), SOURCE)
            )
    return both_sides(landmarks, skin), tuple(depths)


# Regions of the ICT-FaceKit face.

# Vertices of the published 68 facial landmarks that bound the regions.
LANDMARKS = {
    "brow_medial_l": 3615,
    "brow_lateral_l": 2509,
    "sellion": 978,
    "nose_tip": 4857,
    "subnasale": 1147,
    "alar_curvature_l": 3360,
    "exocanthion_l": 3721,
    "endocanthion_l": 3742,
    "cheilion_l": 6213,
    "stomion_superius": 5533,
    "stomion_inferius": 5517,
    "labrale_superius": 0,
    "labrale_inferius": 5518,
    "mentolabial_sulcus": 10,
    "pogonion": 968,
}


def named_regions(skin: Floats, sides: Ints) -> dict[str, Ints]:
    """Return region -> narrow-face vertices; the regions do not overlap and leave none out.

    ``sides`` (n,) tells the lips of the ``skin`` (n, 3) apart, as :func:`lip_sides` does.
    """
    at = {name: skin[vertex] for name, vertex in LANDMARKS.items()}
    face = np.array(ict_facekit.NARROW_FACE)
    x, y = np.abs(skin[face, 0]), skin[face, 1]
    mouth_width = at["cheilion_l"][0] + 5
    mouth_y = at["stomion_superius"][1] - 0.4
    chin_y = at["mentolabial_sulcus"][1]
    lips = (x < mouth_width) & (y < at["subnasale"][1] + 2) & (y > chin_y)
    nose_width = at["alar_curvature_l"][0] + 5
    eye_y, eye_x = at["exocanthion_l"][1], at["exocanthion_l"][0]
    brow_y = at["brow_lateral_l"][1]
    tests = {
        "forehead": y > brow_y + 14,
        "brows": y > brow_y - 4,
        "nose": (x < nose_width)
        & (y > at["subnasale"][1] - 1)
        & (x < 7 + 0.3 * (at["sellion"][1] + 8 - y)),
        "eyes": (y > eye_y - 20) & (x < eye_x + 8),
        "upper_lip": lips & (sides[face] == UPPER),
        "lower_lip": lips & (sides[face] == LOWER),
        "chin": (x < mouth_width) & (y <= chin_y),
        "jaw": y < mouth_y,
        "cheeks": np.ones(len(face), dtype=bool),
    }
    regions: dict[str, Ints] = {}
    free = np.ones(len(face), dtype=bool)
    for name, test in tests.items():
        regions[name] = face[free & test]
        free &= ~test
    return regions


# The template of the ICT-FaceKit topology with the anatomy of BodyParts3D.


BACK_Z, BOTTOM_Y = 24.0, -95.5  # cut planes, mm
PARTING = 0.4  # weight of each expression that parts the lips
PARTING_EXPRESSIONS = ("mouthLowerDown_L", "mouthLowerDown_R", "mouthUpperUp_L", "mouthUpperUp_R")


def build_ict_template(anatomy_dir: Path, faces_dir: Path) -> Template:
    """Return the template of the ICT-FaceKit topology with the anatomy of BodyParts3D.

    Parameters
    ----------
    anatomy_dir
        BodyParts3D, in one of the forms that :mod:`solver.templates.bodyparts3d` reads.
    faces_dir
        ICT-FaceKit, in one of the forms that :mod:`solver.templates.ict_facekit` reads.

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
    motion = fit_similarity(rest[teeth], moved[teeth])
    with_jaw = np.linalg.norm(moved - motion(rest), axis=1)
    with_head = np.linalg.norm(moved - rest, axis=1)
    inner = np.arange(ict_facekit.GUMS_AND_TONGUE.start, ict_facekit.EYEBALLS.start)
    return np.asarray(inner[with_jaw[inner] < with_head[inner]])


def _condyles(mandible: Surface, size_mm: float = 10.0) -> Floats:
    """Return the centres (2, 3) of the left and right condyle: the highest point's surroundings."""
    centres = []
    for side in (1, -1):
        half = mandible.vertices[mandible.vertices[:, 0] * side > 0]
        back = half[half[:, 2] < np.quantile(half[:, 2], 0.3)]
        top = back[np.argmax(back[:, 1])]
        near = back[np.linalg.norm(back - top, axis=1) < size_mm]
        centres.append((near.min(axis=0) + near.max(axis=0)) / 2)
    return np.array(centres)
