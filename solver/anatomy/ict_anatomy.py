"""The skull and muscles of BodyParts3D in the ICT-FaceKit head.

The head is symmetric, and so is what is put into it: the left half of BodyParts3D and its mirror
image. A similarity from teeth and eyes, then the least bending warp that keeps landmarks and
soft-tissue depths, carries it there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from solver.anatomy import bodyparts3d, ict_facekit
from solver.anatomy.bodyparts3d import Part
from solver.anatomy.bones import VoxelGrid, wrap_bones
from solver.anatomy.depth_warp import Landmarks, Limits, depth_warp
from solver.anatomy.ict_facekit import FaceKit
from solver.anatomy.ict_landmarks import DepthTable, depth_landmarks, teeth_and_eyes
from solver.anatomy.skin_depth import SkinDepth
from solver.anatomy.warp import similarity, spread
from solver.surface import Floats, Surface

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
    sample = sample[(sample[:, 1] > LOWEST_Y) & (sample[:, 0] >= 0)]
    bone_limits = _bone_limits(
        bodyparts3d.merged(parts, "cranium", "mandible"), align, depths, outer
    )
    landmarks = _left(
        align(np.vstack([teeth.source, anchors.source])),
        np.vstack([teeth.target, anchors.target]),
    )
    first = depth_warp(
        landmarks,
        [bone_limits, Limits(sample, MUSCLE_DEPTH_MM, np.inf, outer)],
        centres=300,
        stiffness=0.5,
    )
    skull, jaw = (
        surface.moved(first(align(surface.vertices)))
        for surface in (bodyparts3d.merged(parts, "cranium"), bodyparts3d.named(parts, "mandible"))
    )
    cranium, mandible = wrap_bones(skull, jaw, head, VoxelGrid(WRAP_LO, WRAP_HI))
    sample = first(sample)
    wraps = [SkinDepth(cranium), SkinDepth(mandible)]
    bed = first(bone_limits.points)
    bed = bed[spread(bed, BED_SAMPLES)]
    # What a wrap has swallowed has to come out: the bone beside it can not be held there.
    buried = sample[np.any([wrap.inside(sample) for wrap in wraps], axis=0)]
    bed = bed[cKDTree(buried).query(bed)[0] > BURIED_MM]
    landmarks = _left(
        np.vstack([bed, first(align(muscle_anchors.source))]),
        np.vstack([bed, muscle_anchors.target]),
    )
    second = depth_warp(
        landmarks,
        [
            Limits(sample, MUSCLE_DEPTH_MM, np.inf, outer),
            Limits(sample, LINING_DEPTH_MM, np.inf, SkinDepth(flesh)),
            *[Limits(sample, -np.inf, -BONE_GAP_MM, wrap) for wrap in wraps],
        ],
        centres=400,
        stiffness=0.1,
    )
    muscles = {name: s.moved(second(first(s.vertices))) for name, s in muscles.items()}
    return Anatomy(cranium, mandible, jaw, muscles)


def _left(source: Floats, target: Floats) -> Landmarks:
    left = source[:, 0] > -ON_MIDDLE_MM
    return Landmarks(source[left], target[left])


def _sampled(vertices: Floats) -> Floats:
    return vertices[spread(vertices, min(MUSCLE_SAMPLES, len(vertices) // 4))]


def _bone_limits(bones: Surface, align: Align, table: DepthTable, depth: SkinDepth) -> Limits:
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
    return Limits(points, least, greatest, depth)
