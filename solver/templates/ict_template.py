"""The template of the ICT-FaceKit topology with the anatomy of BodyParts3D.

The head is symmetric, and so is what is put into it: the left half of BodyParts3D and its mirror
image. A similarity from teeth and eyes, then the least bending warp that keeps landmarks and
soft-tissue depths, carries it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from solver.anatomy.bones import VoxelGrid, wrap_bones
from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, first_match, lips_apart
from solver.anatomy.data import read_table
from solver.anatomy.template import Depth, Template
from solver.anatomy.warp import MIRROR, DepthLimits, PointPairs, SkinDepth, depth_warp, spread
from solver.similarity import Similarity, fit_similarity
from solver.surface import Floats, Ints, Surface, adjacency, inside, nearest_sphere
from solver.templates import bodyparts3d, ict_facekit
from solver.templates.bodyparts3d import AnatomicalPart, muscle_names
from solver.templates.ict_facekit import EYEBALLS, FaceKit

# Corresponding points of BodyParts3D and the ICT-FaceKit head, and the soft-tissue depths.


@dataclass(frozen=True)
class DepthTable:
    """Soft-tissue depths at points of the skull, in mm."""

    points: Floats  # (k, 3)
    mean: Floats  # (k,)
    deviation: Floats  # (k,) standard deviation
    range_sd: float = 2.0  # by so many of these depths may differ from the mean
    spread_mm: float = 18.0  # depths are wanted within about this of their points

    def bounds(self, points: Floats, least_mm: float) -> tuple[Floats, Floats]:
        """Return least and greatest depths (n,); no greatest one far from every landmark."""
        weights = np.exp(-((cdist(points, self.points) / self.spread_mm) ** 2) / 2)
        total = weights.sum(axis=1) + 1e-12
        mean = weights @ self.mean / total
        deviation = weights @ self.deviation / total
        near = total > np.exp(-2.0)
        least = np.where(near, mean - self.range_sd * deviation, 0.0)
        greatest = np.where(near, mean + self.range_sd * deviation, np.inf)
        return np.maximum(least, least_mm), greatest


def teeth_and_eyes(parts: dict[str, AnatomicalPart], kit: FaceKit) -> PointPairs:
    """Return the middles of 28 tooth crowns and the centres of the eyeballs in both models."""
    pairs: list[tuple[Floats, ...]] = []
    skin = kit.skin
    for jaw, numbers in (("upper", ict_facekit.UPPER_TEETH), ("lower", ict_facekit.LOWER_TEETH)):
        # 16 teeth a jaw from left to right; BodyParts3D has no wisdom teeth.
        teeth = _components(skin.faces, numbers)[1:-1]
        for tooth, name in zip(teeth, ict_facekit.TEETH_NAMES, strict=True):
            crown = bodyparts3d.part_surface(parts, name.format(jaw=jaw)).vertices
            pairs.append((_crown(crown, jaw), _crown(skin.vertices[tooth], jaw)))
    eyes = bodyparts3d.part_surface(parts, "eyeball").vertices, skin.vertices[EYEBALLS]
    for side in (1, -1):
        pairs.append(tuple(nearest_sphere(balls[balls[:, 0] * side > 0])[0] for balls in eyes))
    return PointPairs(*np.array(pairs).transpose(1, 0, 2))


def _components(faces: Ints, numbers: range) -> list[Ints]:
    own = faces[ict_facekit.faces_within(faces, numbers)] - numbers.start
    count, labels = connected_components(adjacency(own, len(numbers)), directed=False)
    return [np.flatnonzero(labels == number) + numbers.start for number in range(count)]


def _crown(tooth: Floats, jaw: str, height_mm: float = 8.0) -> Floats:
    """Return the middle of the lowest or highest ``height_mm`` of a tooth."""
    height = tooth[:, 1] if jaw == "upper" else -tooth[:, 1]
    crown = tooth[height < height.min() + height_mm]
    return np.asarray((crown.min(axis=0) + crown.max(axis=0)) / 2)


def depth_landmarks(skin: Surface) -> tuple[PointPairs, PointPairs, DepthTable]:
    """Return skull anchors, muscle anchors and depths from ``bodyparts3d_landmarks.csv``.

    Rows of kind ``anchor`` fix a point of the skull at its mean depth under a skin vertex, those of
    kind ``muscle`` a point of a muscle; those of kind ``depth`` only say how deep the bone lies.
    """
    normals = trimesh.Trimesh(skin.vertices, skin.faces, process=False).vertex_normals
    anchors: dict[str, list[tuple[Floats, Floats]]] = {"anchor": [], "muscle": [], "depth": []}
    depths = []
    for row in read_table("bodyparts3d_landmarks"):
        point = np.array([float(row[axis]) for axis in "xyz"])
        vertex = int(row["skin_vertex"])
        depth = float(row["depth_mm"])
        under = skin.vertices[vertex] - depth * normals[vertex]
        pairs = [(point, under)]
        if row["side"] == "both":
            pairs.append((bodyparts3d.reflect(point), under * MIRROR))
        anchors[row["kind"]] += pairs
        if row["kind"] != "muscle":
            depths += [(*source, depth, float(row["sd_mm"])) for source, _ in pairs]
    table = np.array(depths)
    bone, muscle = (
        PointPairs(*np.array(anchors[kind]).transpose(1, 0, 2)) for kind in ("anchor", "muscle")
    )
    return bone, muscle, DepthTable(table[:, :3], table[:, 3], table[:, 4])


# Bones and muscles, carried into the head.

WRAP_LO = np.array([-100.0, -110.0, 12.0])  # the box of the bone wraps
WRAP_HI = np.array([100.0, 155.0, 125.0])


@dataclass(frozen=True)
class CarryOptions:
    """Depths, gaps and samples of the two warps that carry bones and muscles."""

    muscle_depth_mm: float = 1.8  # least depth of muscles and bones under the skin (dermis)
    lowest_y: float = -105.0  # anatomy below this height of the head takes no part in the fit
    bone_samples: int = 900  # points of one half of the bones whose depth is kept
    muscle_samples: int = 120  # points of each muscle that are kept inside the flesh
    bed_samples: int = 200  # points of the bones that muscles stay attached to in the second warp
    buried_mm: float = 4.0  # around muscles inside wrapped bone, bones do not hold the second warp
    on_middle_mm: float = 0.5  # landmarks this far on the right still count as those of the middle
    lining_depth_mm: float = 0.3  # least depth of muscles under the lining of mouth and eyelids
    bone_gap_mm: float = 0.2  # least distance between muscles and wrapped bones


CARRY = CarryOptions()


@dataclass(frozen=True)
class Anatomy:
    """Bones and muscles of BodyParts3D inside the head; ``jaw`` is the mandible before wrapping."""

    cranium: Surface
    mandible: Surface
    jaw: Surface
    muscles: dict[str, Surface]


def carry_anatomy(parts: dict[str, AnatomicalPart], kit: FaceKit) -> Anatomy:
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
    head = kit.part(ict_facekit.HEAD)
    flesh = kit.part(ict_facekit.FLESH)
    outer = SkinDepth(head)
    muscles = {name: align(parts[name].surface.vertices) for name in muscle_names(parts)}
    most = CARRY.muscle_samples
    sample = np.vstack([v[spread(v, min(most, len(v) // 4))] for v in muscles.values()])
    sample = sample[(sample[:, 1] > CARRY.lowest_y) & (sample[:, 0] >= 0)]
    bones = bodyparts3d.merge_parts(parts, "cranium", "mandible")
    bone_limits = _bone_limits(bones, align, depths, outer)
    first = depth_warp(
        _left(
            align(np.vstack([teeth.source, anchors.source])),
            np.vstack([teeth.target, anchors.target]),
            CARRY.on_middle_mm,
        ),
        [bone_limits, DepthLimits(sample, CARRY.muscle_depth_mm, np.inf, outer)],
        centres=300,
        stiffness=0.5,
    )
    skull = bodyparts3d.merge_parts(parts, "cranium")
    jaw = bodyparts3d.part_surface(parts, "mandible")
    skull, jaw = (bone.with_vertices(first(align(bone.vertices))) for bone in (skull, jaw))
    cranium, mandible = wrap_bones(skull, jaw, head, VoxelGrid(WRAP_LO, WRAP_HI))
    sample = first(sample)
    wraps = [SkinDepth(cranium), SkinDepth(mandible)]
    bed = first(bone_limits.points)
    bed = bed[spread(bed, CARRY.bed_samples)]
    # What a wrap has swallowed has to come out: the bone beside it cannot be held there.
    buried = sample[np.any([inside(wrap.closed, sample) for wrap in wraps], axis=0)]
    bed = bed[cKDTree(buried).query(bed)[0] > CARRY.buried_mm]
    second = depth_warp(
        _left(
            np.vstack([bed, first(align(muscle_anchors.source))]),
            np.vstack([bed, muscle_anchors.target]),
            CARRY.on_middle_mm,
        ),
        [
            DepthLimits(sample, CARRY.muscle_depth_mm, np.inf, outer),
            DepthLimits(sample, CARRY.lining_depth_mm, np.inf, SkinDepth(flesh)),
            *[DepthLimits(sample, -np.inf, -CARRY.bone_gap_mm, wrap) for wrap in wraps],
        ],
        centres=400,
        stiffness=0.1,
    )
    moved = {
        name: parts[name].surface.with_vertices(second(first(v))) for name, v in muscles.items()
    }
    return Anatomy(cranium, mandible, jaw, moved)


def _left(source: Floats, target: Floats, on_middle_mm: float) -> PointPairs:
    left = source[:, 0] > -on_middle_mm
    return PointPairs(source[left], target[left])


def _bone_limits(
    bones: Surface, align: Similarity, table: DepthTable, depth: SkinDepth
) -> DepthLimits:
    aligned = align(bones.vertices)
    near = np.flatnonzero(
        (aligned[:, 1] > CARRY.lowest_y) & (bones.vertices[:, 0] > bodyparts3d.MIDDLE_X)
    )
    chosen = near[spread(aligned[near], CARRY.bone_samples)]
    least, greatest = table.bounds(bones.vertices[chosen], CARRY.muscle_depth_mm)
    points = aligned[chosen]
    _, deeper = depth(points)
    rays = trimesh.Trimesh(aligned, bones.faces, process=False).ray
    # Only the outermost bone has a greatest depth: not the back of the orbit, not the inner table.
    hidden = rays.intersects_any(points - 0.5 * deeper, -deeper)  # type: ignore[no-untyped-call]
    greatest[hidden] = np.inf
    return DepthLimits(points, least, greatest, depth)


# Landmarks on both sides of the ICT-FaceKit face, and the soft-tissue depths at them.

SOURCE = (
    "Means after Stephan and Simpson (2008) and Rhine and Moore (1982), see sources.csv; entered "
    "by hand, not yet checked against the printed tables"
)
# Vertices of the published 68 facial landmarks that bound the regions.
LANDMARKS = {row["name"]: int(row["skin_vertex"]) for row in read_table("ict_landmarks")}


def both_sides(landmarks: dict[str, int], skin: Floats) -> dict[str, int]:
    """Return landmarks with a right one (``name_r``) for every left one: the face is symmetric."""
    left = [name for name in landmarks if name.endswith("_l")]
    mirrored = skin[[landmarks[name] for name in left]] * MIRROR
    right = cKDTree(skin).query(mirrored)[1].tolist()
    return landmarks | dict(zip([f"{name[:-2]}_r" for name in left], right, strict=True))


def depth_table(skin: Floats) -> tuple[dict[str, int], tuple[Depth, ...]]:
    """Return the landmarks of the depth table in a skin (n, 3), and the depths at them."""
    landmarks = {}
    depths = []
    for row in read_table("bodyparts3d_landmarks"):
        if row["kind"] == "muscle":
            continue
        name = row["name"].replace(" ", "_")
        paired = row["side"] == "both"
        names = (f"{name}_l", f"{name}_r") if paired else (name,)
        landmarks[names[0]] = int(row["skin_vertex"])
        mean = float(row["depth_mm"])
        deviation = float(row["sd_mm"])
        depths += [Depth(each, row["bone"], mean, deviation, SOURCE) for each in names]
    return both_sides(landmarks, skin), tuple(depths)


def named_regions(skin: Floats, sides: Ints) -> dict[str, Ints]:
    """Return region -> narrow-face vertices; the regions do not overlap and leave none out.

    ``sides`` (n,) tells the lips of the ``skin`` (n, 3) apart, as :func:`lip_sides` does.
    """
    at = {name: skin[vertex] for name, vertex in LANDMARKS.items()}
    face = np.array(ict_facekit.NARROW_FACE)
    x = np.abs(skin[face, 0])
    y = skin[face, 1]
    mouth_width = at["cheilion_l"][0] + 5
    mouth_y = at["stomion_superius"][1] - 0.4
    chin_y = at["mentolabial_sulcus"][1]
    brow_y = at["brow_lateral_l"][1]
    lips = (x < mouth_width) & (y < at["subnasale"][1] + 2) & (y > chin_y)
    nose_width = at["alar_curvature_l"][0] + 5
    eye_y = at["exocanthion_l"][1]
    eye_x = at["exocanthion_l"][0]
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
    return first_match(face, tests)


BACK_Z = 24.0  # mm; the plane behind flesh
BOTTOM_Y = -95.5  # mm; the plane under it
PARTING = 0.4  # weight of each expression that parts the lips
PARTING_EXPRESSIONS = ("mouthLowerDown_L", "mouthLowerDown_R", "mouthUpperUp_L", "mouthUpperUp_R")


def build_ict_template(anatomy_dir: Path, faces_dir: Path) -> Template:
    """Return the template of the ICT-FaceKit topology with the anatomy of BodyParts3D.

    ``anatomy_dir`` holds BodyParts3D and ``faces_dir`` ICT-FaceKit, in one of the forms that
    :mod:`solver.templates.bodyparts3d` and :mod:`solver.templates.ict_facekit` read.

    Raises ``anatomy.*``, ``faces.*`` or ``download.*`` where a folder lacks what is needed.
    """
    parts = bodyparts3d.read_parts(anatomy_dir)
    kit = ict_facekit.read_facekit(faces_dir)
    anatomy = carry_anatomy(parts, kit)
    skull = np.vstack([anatomy.cranium.vertices, anatomy.mandible.vertices])
    skin = kit.skin
    points = kit.skin.vertices
    in_front = (points[:, 2] > BACK_Z + 1) & (points[:, 1] > BOTTOM_Y + 1)
    face = np.array(ict_facekit.NARROW_FACE)
    attached_mandible = _moving_with_jaw(kit)
    attached = np.arange(ict_facekit.FLESH.stop, len(points))
    depth_landmarks, depths = depth_table(points)
    landmarks = {**depth_landmarks, **both_sides(LANDMARKS, points)}
    flesh = kit.part(ict_facekit.FLESH)
    sides = lips_apart(flesh, landmarks)
    touching = contact_regions(flesh, sides, _teeth_and_eyes(points), landmarks)
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
        muscles=tuple(
            bodyparts3d.with_table_axis(name, surface, skull)
            for name, surface in anatomy.muscles.items()
        ),
        condyles=_condyles(anatomy.jaw),
        back_z=BACK_Z,
        bottom_y=BOTTOM_Y,
        landmarks=landmarks,
        regions={**named_regions(points, sides), **touching},
        shapes=ict_facekit.shape_basis(kit),
        licence="MIT (ICT-FaceKit) and CC BY 4.0 (BodyParts3D)",
        depths=depths,
        texture=kit.texture,
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
    rest = kit.skin.vertices
    moved = kit.skin.vertices + kit.deltas["jawOpen"]
    teeth = ict_facekit.LOWER_TEETH
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
