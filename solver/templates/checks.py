"""Checks of a template's skin, bones, landmarks, depths, tetrahedra and muscles."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import igl
import numpy as np

from solver.anatomy.depth_warp import SkinDepth, boundary_edges
from solver.anatomy.muscle_weights import contains, enclosed_volume, muscle_volumes
from solver.anatomy.template import Muscle, Template
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.errors import Finding
from solver.registration.landmarks import IBUG_68, SYNONYMS
from solver.surface import Floats, Surface, directed_edges

SIDES = (("_l", "_r", 1.0), ("_r", "_l", -1.0))


@dataclass(frozen=True)
class AnatomyBounds:
    """Sizes and distances that a sound template keeps to."""

    # Least and greatest height of the part of a head that is fitted.
    face_mm: tuple[float, float] = (90.0, 320.0)
    # Bone may lie this far outside the skin, or in another bone, by rounding alone.
    touching_mm: float = 0.3
    condyle_mm: float = 8.0  # a condyle's centre is at most this far from the mandible's surface
    depth_mm: tuple[float, float] = (1.0, 45.0)  # soft tissue is never thinner or thicker on a face
    depth_sd: float = 3.0  # the bone's depth may differ from the table's by so many deviations ...
    # ... and by so much where none is known.
    depth_slack_mm: float = 4.0
    dihedral_deg: float = 5.0  # least angle of a tetrahedron
    volume_kept: float = 0.85  # part of a muscle's volume that its tetrahedra should have
    muscle_mm3: float = 15.0  # no muscle of the face is smaller
    open_edges: int = 12  # smaller gaps do not matter: the inside is found by winding numbers
    # Vertices of a muscle further outside the flesh, or deeper in a bone, are counted.
    out_mm: float = 0.5
    few: float = 0.05  # part of a muscle's vertices that is worth a look ...
    # ... and that makes it useless.
    most: float = 0.5
    # Most from the middle of an origin to bone: it is the middle of a broad one.
    origin_mm: float = 15.0
    insertion_mm: float = 20.0  # most from the middle of an insertion to skin or bone
    partner_mm: float = 8.0  # most between a muscle's middle and the mirror image of its partner's
    partner_volume: float = 1.5  # greatest ratio of two partners' volumes


BOUNDS = AnatomyBounds()


def error(code: str, about: str, message: str) -> Finding:
    """Return a finding about a part, such as a muscle, that makes the template of no use."""
    return Finding(code, "error", message, context={"about": about})


def warning(code: str, about: str, message: str) -> Finding:
    """Return a finding about a part that is worth a look."""
    return Finding(code, "warning", message, context={"about": about})


def flesh_surface(template: Template) -> Surface:
    """Return the part of the skin that bounds the flesh."""
    return Surface(template.skin.vertices, template.skin.faces[template.flesh_faces])


def check_description(template: Template) -> Iterator[Finding]:
    """Check that the template says where it is from and what it may be used for."""
    if template.licence.strip().lower() in ("", "unknown"):
        yield warning(
            "licence.missing", "template", "nobody said under which licence it may be used"
        )
    if not template.source.strip():
        yield warning("source.missing", "template", "nobody said what it was made from")


def check_skin(template: Template) -> Iterator[Finding]:
    """Check size, orientation and topology of the skin, and the sets of its vertices."""
    skin, flesh = template.skin, flesh_surface(template)
    height = float(np.ptp(skin.vertices[template.face_vertices, 1]))
    if not BOUNDS.face_mm[0] <= height <= BOUNDS.face_mm[1]:
        yield error(
            "skin.size",
            "skin",
            f"the face is {height:.4g} mm high: the unit or the axes are not those of the template",
        )
    crowded = _edges_of_many_faces(skin)
    if crowded:
        yield error("skin.edges", "skin", f"{crowded} edges belong to more than two triangles")
    flat = int(np.sum(igl.doublearea(skin.vertices, skin.faces) < 1e-9))
    if flat:
        yield warning("skin.flat", "skin", f"{flat} triangles have no area")
    if _signed_volume(flesh) < 0:
        yield error("skin.inside_out", "skin", "its triangles are turned inwards")
    outside = np.setdiff1d(template.face_vertices, flesh.faces)
    if len(outside):
        yield error(
            "parts.face",
            "face",
            f"{len(outside)} vertices, the first is {outside[0]}, have no flesh",
        )
    both = np.intersect1d(template.attached_cranium, template.attached_mandible)
    if len(both):
        yield error("parts.attached", "skin", f"vertex {both[0]} moves with both bones")
    behind = skin.vertices[template.face_vertices] <= [-np.inf, template.bottom_y, template.back_z]
    if behind.any():
        count = int(behind.any(axis=1).sum())
        yield error(
            "planes", "face", f"{count} vertices of the face are behind or below the planes"
        )
    if np.linalg.norm(template.parting, axis=1).max() < 0.5:
        yield warning("parting", "skin", "the lips are not parted: closed ones cannot be meshed")


def check_bones(template: Template) -> Iterator[Finding]:
    """Check that the bones are solid, under the skin, and apart; and the condyles."""
    depth = SkinDepth(flesh_surface(template))
    bones = {"cranium": template.cranium, "mandible": template.mandible}
    for name, bone in bones.items():
        if len(boundary_edges(bone.faces)[0]) or _edges_of_many_faces(bone):
            yield error("bone.open", name, "its surface is not closed")
        elif _signed_volume(bone) < 0:
            yield error("bone.inside_out", name, "its triangles are turned inwards")
        out = _through_face(template, depth, bone)
        if len(out):
            yield error(
                "bone.outside",
                name,
                f"{len(out)} vertices come through the face, up to {out.max():.1f} mm",
            )
    shared = bones["mandible"].vertices[contains(bones["cranium"], bones["mandible"].vertices)]
    if len(shared):
        deep = distance_to(bones["cranium"], shared).max()
        if deep > BOUNDS.touching_mm:
            yield error("bone.overlap", "mandible", f"it is up to {deep:.1f} mm inside the cranium")
    gap = distance_to(template.mandible, template.condyles)
    for side, sign, condyle, far in zip(
        ("left", "right"), (1, -1), template.condyles, gap, strict=True
    ):
        if condyle[0] * sign <= 0:
            yield error("condyle.side", f"{side} condyle", "it is on the other side")
        if far > BOUNDS.condyle_mm:
            yield error("condyle.place", f"{side} condyle", f"it is {far:.1f} mm from the mandible")


def check_landmarks(template: Template) -> Iterator[Finding]:
    """Check that landmarks are there, lie on their side, and come in pairs."""
    if not template.landmarks:
        yield error("landmarks.missing", "landmarks", "there is none")
    used = np.unique(flesh_surface(template).faces)
    known = {SYNONYMS.get(name, name) for name in template.landmarks}
    unknown = sorted(set(IBUG_68.values()) - known)
    if unknown:
        yield warning(
            "landmarks.scheme",
            "landmarks",
            f"missing of those that landmark files of scans name: {', '.join(unknown)}",
        )
    alone = []
    for name, vertex in template.landmarks.items():
        if vertex not in used:
            yield warning(
                "landmarks.place", name, f"vertex {vertex} is not on the skin of the flesh"
            )
        for own, other, sign in SIDES:
            if name.endswith(own):
                if sign * template.skin.vertices[vertex, 0] <= 0:
                    yield error("landmarks.side", name, "it is on the other side: left is +x")
                if name.removesuffix(own) + other not in template.landmarks:
                    alone.append(name)
    if alone:
        yield warning("landmarks.pair", "landmarks", f"without a partner: {', '.join(alone)}")


def check_depths(template: Template) -> Iterator[Finding]:
    """Check the table of soft-tissue depths, and the bones by it."""
    if not template.depths:
        yield warning("depths.missing", "depths", "there is no table of soft-tissue depths")
    flesh = flesh_surface(template)
    normals = np.nan_to_num(igl.per_vertex_normals(flesh.vertices, flesh.faces))
    for row in template.depths:
        if row.landmark not in template.landmarks:
            yield error(
                "depths.landmark", row.landmark, "the table names it, but it is no landmark"
            )
            continue
        if not BOUNDS.depth_mm[0] <= row.mean <= BOUNDS.depth_mm[1]:
            yield error("depths.range", row.landmark, f"a depth of {row.mean:g} mm cannot be")
        if row.deviation is not None and not 0 < row.deviation < row.mean:
            yield error(
                "depths.range", row.landmark, f"a deviation of {row.deviation:g} mm cannot be"
            )
        vertex = template.landmarks[row.landmark]
        bone = template.cranium if row.bone == "cranium" else template.mandible
        near, across = _depths_of(bone, template.skin.vertices[vertex], normals[vertex])
        allowed = max(BOUNDS.depth_slack_mm, BOUNDS.depth_sd * (row.deviation or 0.0))
        if not near - allowed <= row.mean <= across + allowed:
            found = near if row.mean < near else across
            yield warning(
                "depths.bone",
                row.landmark,
                f"the {row.bone} is {found:.1f} mm under it, the table says {row.mean:g} mm",
            )


def check_mesh(template: Template) -> Iterator[Finding]:
    """Check the tetrahedra and what they hold of the muscles."""
    mesh = template.mesh
    if mesh is None:
        yield warning(
            "mesh.missing", "mesh", "no tetrahedra yet: they are made with the first subject"
        )
        return
    inverted = int(np.sum(volumes(mesh.vertices, mesh.tets) <= 0))
    if inverted:
        yield error("mesh.inverted", "mesh", f"{inverted} tetrahedra are inside out")
    angle = float(dihedral_angles(mesh.vertices, mesh.tets).min())
    if angle < BOUNDS.dihedral_deg:
        yield warning("mesh.flat", "mesh", f"the smallest dihedral angle is {angle:.1f} degrees")
    lost = np.setdiff1d(template.face_vertices, mesh.embedded)
    if len(lost):
        yield error("mesh.uncovered", "mesh", f"{len(lost)} vertices of the face do not follow it")
    candidates = np.bincount(mesh.weights.indices, minlength=len(template.muscles) + 1)[1:]
    held = muscle_volumes(mesh.vertices, mesh.tets, mesh.weights)
    for muscle, count, volume in zip(template.muscles, candidates, held, strict=True):
        if not count:
            yield error("mesh.candidates", muscle.name, "no tetrahedron is near it")
            continue
        if not in_front(template, muscle.surface.vertices).all():
            continue
        kept = volume / max(enclosed_volume(muscle.surface), 1e-9)
        if kept < BOUNDS.volume_kept:
            yield warning("mesh.volume", muscle.name, f"{kept:.0%} of its volume is in tetrahedra")


def distance_to(surface: Surface, points: Floats) -> Floats:
    """Return distances (n,) in mm from points to a surface."""
    points = np.ascontiguousarray(points, dtype=float)
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)[0]
    distances: Floats = np.sqrt(np.asarray(squared))
    return distances


def in_front(template: Template, points: Floats) -> np.ndarray:
    """Return (n,) True where there is flesh by the template's planes."""
    return np.asarray((points[:, 2] > template.back_z) & (points[:, 1] > template.bottom_y))


def _through_face(template: Template, depth: SkinDepth, bone: Surface) -> Floats:
    """Return how far (k,) vertices are outside the face: teeth may be in the mouth's opening."""
    ahead = np.ascontiguousarray(bone.vertices[in_front(template, bone.vertices)])
    if not len(ahead):
        return np.zeros(0)
    out = -depth(ahead)[0]
    flesh = flesh_surface(template)
    nearest = igl.point_mesh_squared_distance(ahead, flesh.vertices, flesh.faces)[1]
    by_face = np.isin(flesh.faces[nearest], template.face_vertices).all(axis=1)
    return np.asarray(out[by_face & (out > BOUNDS.touching_mm)])


def _depths_of(bone: Surface, point: Floats, normal: Floats) -> tuple[float, float]:
    """Return how far in mm a bone is from a point of the skin, and how far along the normal.

    Tables measure across the skin (Stephan and Simpson 2008), which way that is on a slope differs.
    """
    near = float(distance_to(bone, point[None])[0])
    hits = igl.ray_mesh_intersect(point, -normal, bone.vertices, bone.faces)
    return near, float(hits[0][1]) if hits else near


def _signed_volume(surface: Surface) -> float:
    """Return the volume in mm^3, negative if the triangles are turned inwards; holes are closed."""
    corners = surface.vertices - surface.vertices[surface.faces].mean(axis=(0, 1))
    volume = np.linalg.det(corners[surface.faces]).sum()
    edges, hole = boundary_edges(surface.faces)
    for number in np.unique(hole):
        rim = edges[hole == number]
        middle = corners[np.unique(rim)].mean(axis=0)
        caps = np.stack([corners[rim[:, 1]], corners[rim[:, 0]], np.tile(middle, (len(rim), 1))], 1)
        volume += np.linalg.det(caps).sum()
    return float(volume) / 6.0


def _edges_of_many_faces(surface: Surface) -> int:
    """Return how many edges belong to more than two triangles."""
    edges = directed_edges(surface.faces)
    counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]
    return int(np.sum(counts > 2))


# Muscles: where they lie, what they are attached to, their partners.


def check_muscles(template: Template) -> Iterator[Finding]:
    """Check every muscle by itself, then each pair."""
    names = [muscle.name for muscle in template.muscles]
    if not names:
        yield error("muscles.missing", "muscles", "there is none")
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield error("muscle.twice", name, "there are several of that name")
    depth = SkinDepth(flesh_surface(template))
    for muscle in template.muscles:
        yield from _check_shape(muscle)
        yield from _check_place(template, muscle, depth)
        yield from _check_attachments(template, muscle)
    yield from _check_pairs(template)


def _check_shape(muscle: Muscle) -> Iterator[Finding]:
    volume = enclosed_volume(muscle.surface)
    if volume < BOUNDS.muscle_mm3:
        yield error("muscle.volume", muscle.name, f"it encloses {volume:.1f} mm3, which is nothing")
    open_edges = len(boundary_edges(muscle.surface.faces)[0])
    if open_edges > BOUNDS.open_edges:
        yield warning("muscle.open", muscle.name, f"its surface has {open_edges} open edges")
    if not np.isclose(np.linalg.norm(muscle.fibre), 1.0, atol=1e-3):
        yield error("muscle.fibre", muscle.name, "its fibre axis is not of length 1")


def _check_place(template: Template, muscle: Muscle, depth: SkinDepth) -> Iterator[Finding]:
    points = muscle.surface.vertices
    ahead = in_front(template, points)
    if not ahead.any():
        yield error("muscle.behind", muscle.name, "all of it is behind or below the planes")
        return
    points = np.ascontiguousarray(points[ahead])
    out = -depth(points)[0]
    yield from _check_part(muscle, "muscle.outside", "outside the flesh", out)
    for name, bone in (("cranium", template.cranium), ("mandible", template.mandible)):
        within = contains(bone, points)
        deep = np.where(within, distance_to(bone, points), 0.0)
        yield from _check_part(muscle, "muscle.in_bone", f"inside the {name}", deep)


def _check_part(
    muscle: Muscle, code: str, where: str, millimetres: np.ndarray
) -> Iterator[Finding]:
    part = float(np.mean(millimetres > BOUNDS.out_mm))
    if part > BOUNDS.few:
        kind = error if part > BOUNDS.most else warning
        yield kind(
            code, muscle.name, f"{part:.0%} of it is {where}, up to {millimetres.max():.1f} mm"
        )


def _check_attachments(template: Template, muscle: Muscle) -> Iterator[Finding]:
    if muscle.ring:
        return
    bones = [
        distance_to(bone, muscle.origin[None])[0] for bone in (template.cranium, template.mandible)
    ]
    if min(bones) > BOUNDS.origin_mm and in_front(template, muscle.origin[None]).all():
        yield warning(
            "muscle.origin", muscle.name, f"its origin is {min(bones):.0f} mm from any bone"
        )
    ends = [flesh_surface(template), template.cranium, template.mandible]
    far = min(distance_to(end, muscle.insertion[None])[0] for end in ends)
    if far > BOUNDS.insertion_mm:
        yield warning(
            "muscle.insertion", muscle.name, f"its insertion is {far:.0f} mm from the skin"
        )
    if (muscle.insertion - muscle.origin) @ muscle.fibre < 0:
        yield error("muscle.fibre", muscle.name, "its fibre axis runs from insertion to origin")


def _check_pairs(template: Template) -> Iterator[Finding]:
    muscles = {muscle.name: muscle for muscle in template.muscles}
    for name, muscle in muscles.items():
        partner = _partner(name)
        if partner is None:
            continue
        if partner not in muscles:
            yield warning("muscle.pair", name, f"there is no {partner}")
        elif _is_left(name):
            yield from _check_pair(name, muscle.surface, muscles[partner].surface)


def _check_pair(name: str, left: Surface, right: Surface) -> Iterator[Finding]:
    middles = [surface.vertices.mean(axis=0) for surface in (left, right)]
    if middles[0][0] < middles[1][0]:
        yield error("muscle.side", name, "left and right are swapped: left is +x")
        return
    apart = float(np.linalg.norm(middles[0] * [-1, 1, 1] - middles[1]))
    if apart > BOUNDS.partner_mm:
        yield warning("muscle.pair", name, f"its partner is {apart:.0f} mm from its mirror image")
    ratio = enclosed_volume(left) / max(enclosed_volume(right), 1e-9)
    if not 1 / BOUNDS.partner_volume < ratio < BOUNDS.partner_volume:
        yield warning("muscle.pair", name, f"it has {ratio:.2f} times its partner's volume")


def _partner(name: str) -> str | None:
    """Return the name of a muscle's partner on the other side; None of one in the middle."""
    swapped = {"left": "right", "right": "left", "_l": "_r", "_r": "_l"}
    found = re.search(r"\b(left|right)\b|_[lr]$", name)
    if found is None:
        return None
    return name[: found.start()] + swapped[found[0]] + name[found.end() :]


def _is_left(name: str) -> bool:
    return name.endswith("_l") or re.search(r"\bleft\b", name) is not None
