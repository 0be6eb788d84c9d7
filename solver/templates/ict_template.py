"""The skull and muscles of BodyParts3D in the ICT-FaceKit head.

The head is symmetric, and so is what is put into it: the left half of BodyParts3D and its mirror
image. A similarity from teeth and eyes, then the least bending warp that keeps landmarks and
soft-tissue depths, carries it there.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from solver.anatomy.bones import VoxelGrid, wrap_bones
from solver.anatomy.contact_regions import (
    LOWER,
    UPPER,
    contact_regions,
    lips_apart,
)
from solver.anatomy.depth_warp import DepthLimits, PointPairs, SkinDepth, depth_warp
from solver.anatomy.muscle_weights import bodyparts3d_muscle
from solver.anatomy.template import Depth, Template
from solver.anatomy.warp import spread
from solver.similarity import fit_similarity
from solver.surface import Floats, Ints, Surface, adjacency
from solver.templates import (
    bodyparts3d,
    ict_facekit,
)
from solver.templates.bodyparts3d import Part
from solver.templates.ict_facekit import FaceKit

# Corresponding points of BodyParts3D and the ICT-FaceKit head, and the soft-tissue depths.


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


def teeth_and_eyes(parts: dict[str, Part], kit: FaceKit) -> PointPairs:
    """Return the middles of 28 tooth crowns and the centres of the eyeballs in both models."""
    source, target = [], []
    skin = kit.skin
    for jaw, numbers in (("upper", ict_facekit.UPPER_TEETH), ("lower", ict_facekit.LOWER_TEETH)):
        # 16 teeth a jaw from left to right; BodyParts3D has no wisdom teeth.
        teeth = _components(skin.faces, numbers)[1:-1]
        for tooth, name in zip(teeth, ict_facekit.TEETH_NAMES, strict=True):
            crown = bodyparts3d.part_surface(parts, name.format(jaw=jaw)).vertices
            source.append(_crown(crown, jaw))
            target.append(_crown(skin.vertices[tooth], jaw))
    eyes = bodyparts3d.part_surface(parts, "eyeball").vertices
    balls = skin.vertices[ict_facekit.EYEBALLS.start : ict_facekit.EYEBALLS.stop]
    for side in (1, -1):
        source.append(_sphere_centre(eyes[eyes[:, 0] * side > 0]))
        target.append(_sphere_centre(balls[balls[:, 0] * side > 0]))
    return PointPairs(np.array(source), np.array(target))


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


def depth_landmarks(skin: Surface) -> tuple[PointPairs, PointPairs, DepthTable]:
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
                pairs.append((bodyparts3d.reflect(point), under * [-1, 1, 1]))
            anchors[row["kind"]] += pairs
            if row["kind"] != "muscle":
                depths += [(*source, depth, float(row["sd_mm"])) for source, _ in pairs]
    table = np.array(depths)
    bone, muscle = (
        PointPairs(*np.array(anchors[kind]).transpose(1, 0, 2)) for kind in ("anchor", "muscle")
    )
    return bone, muscle, DepthTable(table[:, :3], table[:, 3], table[:, 4])


MUSCLE_DEPTH_MM = 1.8
"""Least depth of muscles and bones under the skin (dermis)."""
LOWEST_Y = -105.0
"""Anatomy below this height of the head takes no part in the fit."""
BONE_SAMPLES = 900
"""Points of one half of the bones whose depth is kept."""
MUSCLE_SAMPLES = 120
"""Points of each muscle that are kept inside the flesh."""
BED_SAMPLES = 200
"""Points of the bones that muscles stay attached to in the second warp."""
WRAP_LO = np.array([-100.0, -110.0, 12.0])
WRAP_HI = np.array([100.0, 155.0, 125.0])
BURIED_MM = 4.0
"""Around muscles inside wrapped bone, bones do not hold the second warp."""
ON_MIDDLE_MM = 0.5
LINING_DEPTH_MM = 0.3
"""Least depth of muscles under the lining of mouth and eyelids."""
BONE_GAP_MM = 0.2
"""Least distance between muscles and wrapped bones."""

Align = Callable[[Floats], Floats]


@dataclass(frozen=True)
class Anatomy:
    """Bones and muscles of BodyParts3D inside the head; ``jaw`` is the mandible before wrapping."""

    cranium: Surface
    mandible: Surface
    jaw: Surface
    muscles: dict[str, Surface]


def carry_anatomy(parts: dict[str, Part], kit: FaceKit) -> Anatomy:
    """Return bone wraps and face muscles inside the head.

    A first warp carries bones and muscles by teeth, eyes and soft-tissue depths. A second one
    moves muscles only: it closes the lips' muscle around the mouth, which is open in BodyParts3D,
    and takes muscles out of the wrapped bones and of the hollows of mouth and eyelids.

    Raises :class:`InputError` (``anatomy.part``) for a part that is not there.
    """
    parts = bodyparts3d.symmetric(parts)
    teeth = teeth_and_eyes(parts, kit)
    anchors, muscle_anchors, depths = depth_landmarks(kit.skin)
    align = fit_similarity(teeth.source, teeth.target)

    head, flesh = (
        Surface(kit.skin.vertices, kit.skin.faces[ict_facekit.faces_within(kit.skin.faces, part)])
        for part in (ict_facekit.HEAD, ict_facekit.FLESH)
    )
    outer = SkinDepth(head)
    muscles = {
        name: parts[name].surface.moved(align(parts[name].surface.vertices))
        for name in bodyparts3d.muscle_names(parts)
    }
    sample = np.vstack([_sample(surface.vertices) for surface in muscles.values()])
    sample = sample[(sample[:, 1] > LOWEST_Y) & (sample[:, 0] >= 0)]
    bone_limits = _bone_limits(
        bodyparts3d.merge_parts(parts, "cranium", "mandible"), align, depths, outer
    )
    landmarks = _left(
        align(np.vstack([teeth.source, anchors.source])),
        np.vstack([teeth.target, anchors.target]),
    )
    first = depth_warp(
        landmarks,
        [bone_limits, DepthLimits(sample, MUSCLE_DEPTH_MM, np.inf, outer)],
        centres=300,
        stiffness=0.5,
    )
    skull, jaw = (
        surface.moved(first(align(surface.vertices)))
        for surface in (
            bodyparts3d.merge_parts(parts, "cranium"),
            bodyparts3d.part_surface(parts, "mandible"),
        )
    )
    cranium, mandible = wrap_bones(skull, jaw, head, VoxelGrid(WRAP_LO, WRAP_HI))
    sample = first(sample)
    wraps = [SkinDepth(cranium), SkinDepth(mandible)]
    bed = first(bone_limits.points)
    bed = bed[spread(bed, BED_SAMPLES)]
    # What a wrap has swallowed has to come out: the bone beside it cannot be held there.
    buried = sample[np.any([wrap.inside(sample) for wrap in wraps], axis=0)]
    bed = bed[cKDTree(buried).query(bed)[0] > BURIED_MM]
    landmarks = _left(
        np.vstack([bed, first(align(muscle_anchors.source))]),
        np.vstack([bed, muscle_anchors.target]),
    )
    second = depth_warp(
        landmarks,
        [
            DepthLimits(sample, MUSCLE_DEPTH_MM, np.inf, outer),
            DepthLimits(sample, LINING_DEPTH_MM, np.inf, SkinDepth(flesh)),
            *[DepthLimits(sample, -np.inf, -BONE_GAP_MM, wrap) for wrap in wraps],
        ],
        centres=400,
        stiffness=0.1,
    )
    muscles = {name: s.moved(second(first(s.vertices))) for name, s in muscles.items()}
    return Anatomy(cranium, mandible, jaw, muscles)


def _left(source: Floats, target: Floats) -> PointPairs:
    left = source[:, 0] > -ON_MIDDLE_MM
    return PointPairs(source[left], target[left])


def _sample(vertices: Floats) -> Floats:
    return vertices[spread(vertices, min(MUSCLE_SAMPLES, len(vertices) // 4))]


def _bone_limits(bones: Surface, align: Align, table: DepthTable, depth: SkinDepth) -> DepthLimits:
    aligned = align(bones.vertices)
    near = np.flatnonzero(
        (aligned[:, 1] > LOWEST_Y) & (bones.vertices[:, 0] > bodyparts3d.MIDDLE_X)
    )
    chosen = near[spread(aligned[near], BONE_SAMPLES)]
    least, greatest = table.bounds(bones.vertices[chosen], MUSCLE_DEPTH_MM)
    points = aligned[chosen]
    mesh = trimesh.Trimesh(aligned, bones.faces, process=False)
    _, deeper = depth(points)
    # Only the outermost bone has a greatest depth: not the back of the orbit, not the inner table.
    hidden = mesh.ray.intersects_any(  # type: ignore[no-untyped-call]
        points - 0.5 * deeper, -deeper
    )
    greatest[hidden] = np.inf
    return DepthLimits(points, least, greatest, depth)


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


# Landmarks and named regions of the ICT-FaceKit face.


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
