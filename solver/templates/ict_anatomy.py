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

import numpy as np
import trimesh
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from solver.anatomy.bones import VoxelGrid, wrap_bones
from solver.anatomy.depth_warp import DepthLimits, PointPairs, SkinDepth, depth_warp
from solver.anatomy.warp import spread
from solver.similarity import fit_similarity
from solver.surface import Floats, Ints, Surface, adjacency
from solver.templates import bodyparts3d, ict_facekit
from solver.templates.bodyparts3d import Part
from solver.templates.ict_facekit import FaceKit

# Corresponding points of BodyParts3D and the ICT-FaceKit head, and the soft-tissue depths.


@dataclass(frozen=True)
class DepthTable:
    """Soft-tissue depths at points (k, 3) of the skull, mean and standard deviation in mm.

    Depths may differ from the mean by ``range_sd`` standard deviations, and are wanted within about
    ``spread_mm`` of their points.
    """

    points: Floats
    mean: Floats
    deviation: Floats
    range_sd: float = 2.0
    spread_mm: float = 18.0

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


def _crown(tooth: Floats, jaw: str, height_mm: float = 8.0) -> Floats:
    """Return the middle of the lowest or highest ``height_mm`` of a tooth."""
    height = tooth[:, 1] if jaw == "upper" else -tooth[:, 1]
    crown = tooth[height < height.min() + height_mm]
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


# Bones and muscles, carried into the head.

WRAP_LO = np.array([-100.0, -110.0, 12.0])  # the box of the bone wraps
WRAP_HI = np.array([100.0, 155.0, 125.0])

Align = Callable[[Floats], Floats]


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


def carry_anatomy(parts: dict[str, Part], kit: FaceKit, options: CarryOptions = CARRY) -> Anatomy:
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
    sample = np.vstack(
        [_sample(surface.vertices, options.muscle_samples) for surface in muscles.values()]
    )
    sample = sample[(sample[:, 1] > options.lowest_y) & (sample[:, 0] >= 0)]
    bone_limits = _bone_limits(
        bodyparts3d.merge_parts(parts, "cranium", "mandible"), align, depths, outer, options
    )
    landmarks = _left(
        align(np.vstack([teeth.source, anchors.source])),
        np.vstack([teeth.target, anchors.target]),
        options.on_middle_mm,
    )
    first = depth_warp(
        landmarks,
        [bone_limits, DepthLimits(sample, options.muscle_depth_mm, np.inf, outer)],
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
    bed = bed[spread(bed, options.bed_samples)]
    # What a wrap has swallowed has to come out: the bone beside it cannot be held there.
    buried = sample[np.any([wrap.inside(sample) for wrap in wraps], axis=0)]
    bed = bed[cKDTree(buried).query(bed)[0] > options.buried_mm]
    landmarks = _left(
        np.vstack([bed, first(align(muscle_anchors.source))]),
        np.vstack([bed, muscle_anchors.target]),
        options.on_middle_mm,
    )
    second = depth_warp(
        landmarks,
        [
            DepthLimits(sample, options.muscle_depth_mm, np.inf, outer),
            DepthLimits(sample, options.lining_depth_mm, np.inf, SkinDepth(flesh)),
            *[DepthLimits(sample, -np.inf, -options.bone_gap_mm, wrap) for wrap in wraps],
        ],
        centres=400,
        stiffness=0.1,
    )
    muscles = {name: s.moved(second(first(s.vertices))) for name, s in muscles.items()}
    return Anatomy(cranium, mandible, jaw, muscles)


def _left(source: Floats, target: Floats, on_middle_mm: float) -> PointPairs:
    left = source[:, 0] > -on_middle_mm
    return PointPairs(source[left], target[left])


def _sample(vertices: Floats, most: int) -> Floats:
    return vertices[spread(vertices, min(most, len(vertices) // 4))]


def _bone_limits(
    bones: Surface, align: Align, table: DepthTable, depth: SkinDepth, options: CarryOptions
) -> DepthLimits:
    aligned = align(bones.vertices)
    near = np.flatnonzero(
        (aligned[:, 1] > options.lowest_y) & (bones.vertices[:, 0] > bodyparts3d.MIDDLE_X)
    )
    chosen = near[spread(aligned[near], options.bone_samples)]
    least, greatest = table.bounds(bones.vertices[chosen], options.muscle_depth_mm)
    points = aligned[chosen]
    mesh = trimesh.Trimesh(aligned, bones.faces, process=False)
    _, deeper = depth(points)
    # Only the outermost bone has a greatest depth: not the back of the orbit, not the inner table.
    hidden = mesh.ray.intersects_any(  # type: ignore[no-untyped-call]
        points - 0.5 * deeper, -deeper
    )
    greatest[hidden] = np.inf
    return DepthLimits(points, least, greatest, depth)
