"""The template of the ICT-FaceKit topology with the anatomy of BodyParts3D.

The skull and muscles of one man are carried into the head by a similarity from teeth and eyes,
then by the least bending warp that keeps landmarks and soft-tissue depths.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from solver.anatomy import bodyparts3d, ict_facekit
from solver.anatomy.bodyparts3d import Part
from solver.anatomy.bones import VoxelGrid, wrap_bones
from solver.anatomy.depth_warp import Landmarks, Limits, depth_warp
from solver.anatomy.ict_facekit import FaceKit
from solver.anatomy.ict_regions import LANDMARKS, named_regions
from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.template import Muscle, Template
from solver.anatomy.warp import similarity, spread
from solver.errors import InputError
from solver.surface import Floats, Ints, Surface

CROWN_MM = 8.0
"""Height of the part of a tooth whose middle is the landmark."""
MUSCLE_DEPTH_MM = 1.8
"""Least depth of muscles and bones under the skin (dermis)."""
MIDDLE = np.array([-0.6, 0.0, 0.0])
"""A point in BodyParts3D's plane of symmetry; the head's lies at x = 0."""
LOWEST_Y = -105.0
"""Anatomy below this height of the head takes no part in the fit."""
BONE_SAMPLES = 1800
MUSCLE_SAMPLES = 60
"""Points of each muscle that are kept inside the flesh."""
BED_SAMPLES = 700
"""Points of the bones that muscles stay attached to in the second warp."""
WRAP_LO = np.array([-100.0, -110.0, 12.0])
WRAP_HI = np.array([100.0, 155.0, 125.0])
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
LINING_DEPTH_MM = 0.3
"""Least depth of muscles under the lining of mouth and eyelids."""
BONE_GAP_MM = 0.2
"""Least distance between muscles and wrapped bones."""
RANGE_SD = 2.0
"""Depths may differ from the mean by this many standard deviations."""
DEPTH_SPREAD_MM = 18.0
"""How far around a depth landmark its depth is wanted."""


Align = Callable[[Floats], Floats]


@dataclass(frozen=True)
class DepthTable:
    """Soft-tissue depths at points (k, 3) of the skull, mean and standard deviation in mm."""

    points: Floats
    mean: Floats
    deviation: Floats

    def bounds(self, points: Floats) -> tuple[Floats, Floats]:
        """Return least and greatest depths (n,); no greatest one far from every landmark."""
        weights = np.exp(-((cdist(points, self.points) / DEPTH_SPREAD_MM) ** 2) / 2)
        total = weights.sum(axis=1) + 1e-12
        mean = weights @ self.mean / total
        deviation = weights @ self.deviation / total
        near = total > np.exp(-2.0)
        least = np.where(near, mean - RANGE_SD * deviation, 0.0)
        greatest = np.where(near, mean + RANGE_SD * deviation, np.inf)
        return np.maximum(least, MUSCLE_DEPTH_MM), greatest


def teeth_and_eyes(parts: dict[str, Part], kit: FaceKit) -> Landmarks:
    """Return the middles of 28 tooth crowns and the centres of the eyeballs in both models."""
    source, target = [], []
    skin = kit.skin
    for jaw, numbers in (("upper", ict_facekit.UPPER_TEETH), ("lower", ict_facekit.LOWER_TEETH)):
        # 16 teeth a jaw from left to right; BodyParts3D has no wisdom teeth.
        teeth = _components(skin.faces, numbers)[1:-1]
        for tooth, name in zip(teeth, ict_facekit.TEETH_NAMES, strict=True):
            source.append(_crown(_part(parts, name.format(jaw=jaw)).vertices, jaw))
            target.append(_crown(skin.vertices[tooth], jaw))
    eyes = _part(parts, "eyeball").vertices
    balls = skin.vertices[ict_facekit.EYEBALLS.start : ict_facekit.EYEBALLS.stop]
    for side in (1, -1):
        source.append(_sphere_centre(eyes[eyes[:, 0] * side > 0]))
        target.append(_sphere_centre(balls[balls[:, 0] * side > 0]))
    return Landmarks(np.array(source), np.array(target))


def _part(parts: dict[str, Part], name: str) -> Surface:
    if name not in parts:
        raise InputError("anatomy.part", f"the anatomy has no part named '{name}'", part=name)
    return parts[name].surface


def _components(faces: Ints, numbers: range) -> list[Ints]:
    own = faces[ict_facekit.faces_within(faces, numbers)] - numbers.start
    ones = np.ones(own.size)
    graph = sp.coo_array(
        (ones, (own.ravel(), np.roll(own, 1, axis=1).ravel())), shape=(len(numbers),) * 2
    )
    count, labels = connected_components(graph, directed=False)
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
            for side in (1, -1) if row["side"] == "both" else (0,):
                mirror = np.array([side, 1.0, 1.0])
                source = (point - MIDDLE) * mirror + MIDDLE
                anchors[row["kind"]].append((source, under * mirror))
                if row["kind"] != "muscle":
                    depths.append((*source, depth, float(row["sd_mm"])))
    table = np.array(depths)
    bone, muscle = (
        Landmarks(*np.array(anchors[kind]).transpose(1, 0, 2)) for kind in ("anchor", "muscle")
    )
    return bone, muscle, DepthTable(table[:, :3], table[:, 3], table[:, 4])


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
    """
    teeth = teeth_and_eyes(parts, kit)
    anchors, muscle_anchors, depths = depth_landmarks(kit.skin)
    scale, rotation, shift = similarity(teeth.source, teeth.target)

    def align(points: Floats) -> Floats:
        return scale * points @ rotation.T + shift

    head, flesh = (
        Surface(kit.skin.vertices, kit.skin.faces[ict_facekit.faces_within(kit.skin.faces, part)])
        for part in (ict_facekit.HEAD, ict_facekit.FLESH)
    )
    outer = SkinDepth(head)
    muscles = {
        name: parts[name].surface.moved(align(parts[name].surface.vertices))
        for name in bodyparts3d.muscle_names(parts)
    }
    sample = np.vstack([_sampled(surface.vertices) for surface in muscles.values()])
    sample = sample[sample[:, 1] > LOWEST_Y]
    bone_limits = _bone_limits(
        bodyparts3d.merged(parts, "cranium", "mandible"), align, depths, outer
    )
    landmarks = Landmarks(
        align(np.vstack([teeth.source, anchors.source])),
        np.vstack([teeth.target, anchors.target]),
    )
    first = depth_warp(landmarks, [bone_limits, Limits(sample, MUSCLE_DEPTH_MM, np.inf, outer)])
    skull, jaw = (
        surface.moved(first(align(surface.vertices)))
        for surface in (bodyparts3d.merged(parts, "cranium"), _part(parts, "mandible"))
    )
    cranium, mandible = wrap_bones(skull, jaw, head, VoxelGrid(WRAP_LO, WRAP_HI))
    bed = first(bone_limits.points)
    bed = bed[spread(bed, BED_SAMPLES)]
    landmarks = Landmarks(
        np.vstack([bed, first(align(muscle_anchors.source))]),
        np.vstack([bed, muscle_anchors.target]),
    )
    sample = first(sample)
    second = depth_warp(
        landmarks,
        [
            Limits(sample, MUSCLE_DEPTH_MM, np.inf, outer),
            Limits(sample, LINING_DEPTH_MM, np.inf, SkinDepth(flesh)),
            Limits(sample, -np.inf, -BONE_GAP_MM, SkinDepth(cranium)),
            Limits(sample, -np.inf, -BONE_GAP_MM, SkinDepth(mandible)),
        ],
    )
    muscles = {name: s.moved(second(first(s.vertices))) for name, s in muscles.items()}
    return Anatomy(cranium, mandible, jaw, muscles)


def _sampled(vertices: Floats) -> Floats:
    return vertices[spread(vertices, min(MUSCLE_SAMPLES, len(vertices) // 4))]


def _bone_limits(bones: Surface, align: Align, table: DepthTable, depth: SkinDepth) -> Limits:
    aligned = align(bones.vertices)
    near = np.flatnonzero(aligned[:, 1] > LOWEST_Y)
    chosen = near[spread(aligned[near], BONE_SAMPLES)]
    least, greatest = table.bounds(bones.vertices[chosen])
    points = aligned[chosen]
    mesh = trimesh.Trimesh(aligned, bones.faces, process=False)
    _, deeper = depth(points)
    # Only the outermost bone has a greatest depth: not the back of the orbit, not the inner table.
    hidden = mesh.ray.intersects_any(  # type: ignore[no-untyped-call]
        points - 0.5 * deeper, -deeper
    )
    greatest[hidden] = np.inf
    return Limits(points, least, greatest, depth)


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
