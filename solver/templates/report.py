"""Report on a template as anatomy: findings in plain words, and the figures behind them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import igl
import numpy as np

from solver.anatomy.data import read_table
from solver.anatomy.domain import in_front
from solver.anatomy.embedding import barycentric
from solver.anatomy.muscle_weights import contains, enclosed_volume, muscle_volumes, signed_volume
from solver.anatomy.template import Muscle, Template
from solver.anatomy.tetrahedra import dihedral_angles, volumes
from solver.anatomy.warp import SkinDepth, boundary_edges, close_holes
from solver.errors import Finding, Severity
from solver.registration.landmarks import IBUG_68, SYNONYMS
from solver.surface import Floats, Ints, Surface, directed_edges


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
    most: float = 0.5  # ... and that makes it useless
    # Most from the middle of an origin to bone: it is the middle of a broad one.
    origin_mm: float = 15.0
    insertion_mm: float = 20.0  # most from the middle of an insertion to skin or bone
    partner_mm: float = 8.0  # most between a muscle's middle and the mirror image of its partner's
    partner_volume: float = 1.5  # greatest ratio of two partners' volumes
    part_mm: float = 0.5  # lips that nowhere part by more cannot be meshed


BOUNDS = AnatomyBounds()

PARTNERS = {"left": "right", "right": "left", "_l": "_r", "_r": "_l"}


WORDING = {row["finding"]: row for row in read_table("template_findings")}


def _find(key: str, about: str, *figures: object, severity: str = "") -> Finding:
    """Return a finding about a part, such as a muscle, in the words of the table.

    The code is the first word of ``key``: a code may have several messages.
    """
    row = WORDING[key]
    level = cast(Severity, severity or row["severity"])
    return Finding(key.split()[0], level, row["message"].format(*figures), context={"about": about})


@dataclass(frozen=True)
class TemplateReport:
    """Findings, the worst first, and ``figures`` (JSON values) about the template."""

    findings: tuple[Finding, ...]
    figures: dict[str, Any]

    @property
    def good(self) -> bool:
        """Tell whether the template can be used: there is no error."""
        return not any(finding.severity == "error" for finding in self.findings)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as JSON values; no finding of a template has advice."""
        findings = [finding.to_dict() for finding in self.findings]
        for finding in findings:
            del finding["advice"]
        return {"good": self.good, "findings": findings, "figures": self.figures}


def report_template(template: Template) -> TemplateReport:
    """Return what is wrong with, or worth a look at, a template whose arrays fit together."""
    checks = _Checks(template)
    findings = [
        *checks.description(),
        *checks.skin(),
        *checks.bones(),
        *checks.muscles(),
        *checks.landmarks(),
        *checks.depths(),
        *checks.mesh(),
    ]
    findings.sort(key=lambda finding: finding.severity != "error")
    return TemplateReport(tuple(findings), template_figures(template))


def template_figures(template: Template) -> dict[str, Any]:
    """Return counts and sizes of a template as JSON values."""
    shapes = template.shapes
    mesh = template.mesh
    size = np.ptp(template.skin.vertices[template.face_vertices], axis=0)
    figures: dict[str, Any] = {
        "name": template.name,
        "version": template.version,
        "content_sha256": template.sha256,
        "source": template.source,
        "licence": template.licence,
        "skin_vertices": len(template.skin.vertices),
        "skin_triangles": len(template.skin.faces),
        "face_vertices": len(template.face_vertices),
        "face_size_mm": [round(float(length), 1) for length in size],
        "cranium_cm3": round(enclosed_volume(template.cranium) / 1000.0, 1),
        "mandible_cm3": round(enclosed_volume(template.mandible) / 1000.0, 1),
        "muscles": len(template.muscles),
        "compartments": sum(len(muscle.compartment_names) for muscle in template.muscles),
        "muscle_cm3": {
            muscle.name: round(enclosed_volume(muscle.surface) / 1000.0, 3)
            for muscle in template.muscles
        },
        "landmarks": len(template.landmarks),
        "regions": {name: len(ids) for name, ids in template.regions.items()},
        "depths": len(template.depths),
        "detector_points": 0 if template.points is None else len(template.points.names),
        "identities": 0 if shapes is None else len(shapes.identity),
        "expressions": 0 if shapes is None else len(shapes.expressions),
    }
    if mesh is not None:
        sizes = volumes(mesh.vertices, mesh.tets)
        angle = float(dihedral_angles(mesh.vertices, mesh.tets).min())
        figures["mesh"] = {
            "edge_mm": mesh.edge_mm,
            "vertices": len(mesh.vertices),
            "tets": len(mesh.tets),
            "volume_cm3": round(float(sizes.sum()) / 1000.0, 1),
            "inverted": int(np.sum(sizes <= 0)),
            "smallest_dihedral_deg": round(angle, 2),
            "candidates_per_tet": round(mesh.weights.nnz / len(mesh.tets) - 1.0, 2),
            "trained": mesh.trained is not None,
        }
    return figures


class _Checks:
    """The checks of one template, each of which yields what it finds."""

    def __init__(self, template: Template) -> None:
        self.template = template
        self.flesh = template.flesh
        self.solid = {"cranium": template.cranium, "mandible": template.mandible}

    @cached_property
    def depth(self) -> SkinDepth:
        """Depths under the skin of the flesh."""
        return SkinDepth(self.flesh)

    def description(self) -> Iterator[Finding]:
        """Check that the template says where it is from and what it may be used for."""
        if self.template.licence.strip().lower() in ("", "unknown"):
            yield _find("licence.missing", "template")
        if not self.template.source.strip():
            yield _find("source.missing", "template")

    def skin(self) -> Iterator[Finding]:
        """Check size, orientation and topology of the skin, and the sets of its vertices."""
        template = self.template
        skin = self.template.skin
        face = skin.vertices[template.face_vertices]
        height = float(np.ptp(face[:, 1]))
        if not BOUNDS.face_mm[0] <= height <= BOUNDS.face_mm[1]:
            yield _find("skin.size", "skin", height)
        if crowded := _edges_of_many_faces(skin):
            yield _find("skin.edges", "skin", crowded)
        if flat := int(np.sum(igl.doublearea(skin.vertices, skin.faces) < 1e-9)):
            yield _find("skin.flat", "skin", flat)
        if signed_volume(close_holes(self.flesh)) < 0:
            yield _find("skin.inside_out", "skin")
        outside = np.setdiff1d(template.face_vertices, self.flesh.faces)
        if len(outside):
            yield _find("parts.face", "face", len(outside), outside[0])
        both = np.intersect1d(template.attached_cranium, template.attached_mandible)
        if len(both):
            yield _find("parts.attached", "skin", both[0])
        behind = (face[:, 1] <= template.bottom_y) | (face[:, 2] <= template.back_z)
        if behind.any():
            yield _find("planes", "face", int(behind.sum()))
        if np.linalg.norm(template.parting, axis=1).max() < BOUNDS.part_mm:
            yield _find("parting", "skin")

    def bones(self) -> Iterator[Finding]:
        """Check that the bones are solid, under the skin, and apart; and the condyles."""
        template = self.template
        for name, bone in self.solid.items():
            if len(boundary_edges(bone.faces)[0]) or _edges_of_many_faces(bone):
                yield _find("bone.open", name)
            elif signed_volume(bone) < 0:
                yield _find("bone.inside_out", name)
            out = self._through_face(bone)
            if len(out):
                yield _find("bone.outside", name, len(out), out.max())
        jaw = template.mandible.vertices
        shared = jaw[contains(template.cranium, jaw)]
        if len(shared):
            deep = barycentric(shared, template.cranium)[2].max()
            if deep > BOUNDS.touching_mm:
                yield _find("bone.overlap", "mandible", deep)
        gap = barycentric(template.condyles, template.mandible)[2]
        outward = template.condyles[:, 0] * [1, -1]
        for side, out, far in zip(("left", "right"), outward, gap, strict=True):
            if out <= 0:
                yield _find("condyle.side", f"{side} condyle")
            if far > BOUNDS.condyle_mm:
                yield _find("condyle.place", f"{side} condyle", far)

    def _through_face(self, bone: Surface) -> Floats:
        """Return how far (k,) vertices stick out of the face; teeth may be in the opening."""
        ahead = np.ascontiguousarray(bone.vertices[in_front(self.template, bone.vertices)])
        if not len(ahead):
            return np.zeros(0)
        out = -self.depth(ahead)[0]
        nearest, is_edge = self._nearest(ahead)
        by_face = np.isin(nearest, self.template.face_vertices).all(axis=1) & ~is_edge
        return np.asarray(out[by_face & (out > BOUNDS.touching_mm)])

    def _nearest(self, points: Floats) -> tuple[Ints, np.ndarray]:
        """Return the nearest triangles (k, 3) of the flesh, and which (k,) are at its edge.

        Beside the edge of a bare face there is no skin that anything could be under.
        """
        nearest = self.flesh.faces[barycentric(points, self.flesh)[0]]
        edge = boundary_edges(self.flesh.faces)[0]
        return nearest, np.asarray(np.isin(nearest, edge).any(axis=1))

    def landmarks(self) -> Iterator[Finding]:
        """Check that landmarks are there, lie on their side, and come in pairs."""
        landmarks = self.template.landmarks
        if not landmarks:
            yield _find("landmarks.missing", "landmarks")
        used = np.unique(self.flesh.faces)
        unknown = set(IBUG_68.values()) - {SYNONYMS.get(name, name) for name in landmarks}
        if unknown:
            yield _find("landmarks.scheme", "landmarks", ", ".join(sorted(unknown)))
        alone = []
        for name, vertex in landmarks.items():
            if vertex not in used:
                yield _find("landmarks.place", name, vertex)
            if not name.endswith(("_l", "_r")):
                continue
            if (1 if name.endswith("_l") else -1) * self.flesh.vertices[vertex, 0] <= 0:
                yield _find("landmarks.side", name)
            if name[:-2] + PARTNERS[name[-2:]] not in landmarks:
                alone.append(name)
        if alone:
            yield _find("landmarks.pair", "landmarks", ", ".join(alone))

    def depths(self) -> Iterator[Finding]:
        """Check the table of soft-tissue depths, and the bones by it."""
        template = self.template
        flesh = self.flesh
        if not template.depths:
            yield _find("depths.missing", "depths")
        normals = np.nan_to_num(igl.per_vertex_normals(flesh.vertices, flesh.faces))
        for row in template.depths:
            if row.landmark not in template.landmarks:
                yield _find("depths.landmark", row.landmark)
                continue
            if not BOUNDS.depth_mm[0] <= row.mean <= BOUNDS.depth_mm[1]:
                yield _find("depths.range mean", row.landmark, row.mean)
            if row.deviation is not None and not 0 < row.deviation < row.mean:
                yield _find("depths.range deviation", row.landmark, row.deviation)
            vertex = template.landmarks[row.landmark]
            bone = self.solid[row.bone]
            near, across = _depths_of(bone, flesh.vertices[vertex], normals[vertex])
            allowed = max(BOUNDS.depth_slack_mm, BOUNDS.depth_sd * (row.deviation or 0.0))
            if not near - allowed <= row.mean <= across + allowed:
                found = near if row.mean < near else across
                yield _find("depths.bone", row.landmark, row.bone, found, row.mean)

    def mesh(self) -> Iterator[Finding]:
        """Check the tetrahedra and what they hold of the muscles."""
        template = self.template
        mesh = self.template.mesh
        if mesh is None:
            yield _find("mesh.missing", "mesh")
            return
        if inverted := int(np.sum(volumes(mesh.vertices, mesh.tets) <= 0)):
            yield _find("mesh.inverted", "mesh", inverted)
        angle = float(dihedral_angles(mesh.vertices, mesh.tets).min())
        if angle < BOUNDS.dihedral_deg:
            yield _find("mesh.flat", "mesh", angle)
        lost = np.setdiff1d(template.face_vertices, mesh.embedded)
        if len(lost):
            yield _find("mesh.uncovered", "mesh", len(lost))
        candidates = np.bincount(mesh.weights.indices, minlength=len(template.muscles) + 1)[1:]
        held = muscle_volumes(mesh.vertices, mesh.tets, mesh.weights)
        for muscle, count, volume in zip(template.muscles, candidates, held, strict=True):
            kept = volume / max(enclosed_volume(muscle.surface), 1e-9)
            if not count:
                yield _find("mesh.candidates", muscle.name)
            elif kept < BOUNDS.volume_kept and self._ahead(muscle).all():
                yield _find("mesh.volume", muscle.name, kept)

    def _ahead(self, muscle: Muscle) -> np.ndarray:
        return in_front(self.template, muscle.surface.vertices)

    def muscles(self) -> Iterator[Finding]:
        """Check every muscle by itself, then each pair."""
        muscles = self.template.muscles
        names = [name for muscle in muscles for name in muscle.compartment_names]
        if not names:
            yield _find("muscles.missing", "muscles")
        for name in sorted({name for name in names if names.count(name) > 1}):
            yield _find("muscle.twice", name)
        for muscle in muscles:
            yield from self._shape(muscle)
            yield from self._place(muscle)
            if not muscle.ring:
                yield from self._attachments(muscle)
        yield from self._pairs({muscle.name: muscle.surface for muscle in muscles})

    def _shape(self, muscle: Muscle) -> Iterator[Finding]:
        volume = enclosed_volume(muscle.surface)
        if volume < BOUNDS.muscle_mm3:
            yield _find("muscle.volume", muscle.name, volume)
        open_edges = len(boundary_edges(muscle.surface.faces)[0])
        if open_edges > BOUNDS.open_edges:
            yield _find("muscle.open", muscle.name, open_edges)
        if not np.isclose(np.linalg.norm(muscle.fibre), 1.0, atol=1e-3):
            yield _find("muscle.fibre length", muscle.name)

    def _place(self, muscle: Muscle) -> Iterator[Finding]:
        points = np.ascontiguousarray(muscle.surface.vertices[self._ahead(muscle)])
        if not len(points):
            yield _find("muscle.behind", muscle.name)
            return
        out = np.where(self._nearest(points)[1], 0.0, -self.depth(points)[0])
        yield from self._part(muscle, "muscle.outside", out)
        for name, bone in self.solid.items():
            deep = np.where(contains(bone, points), barycentric(points, bone)[2], 0.0)
            yield from self._part(muscle, "muscle.in_bone", deep, name)

    def _part(self, muscle: Muscle, code: str, out: Floats, *place: str) -> Iterator[Finding]:
        """Judge a muscle by the distances ``out`` (k,), mm, of its points from its place."""
        part = float(np.mean(out > BOUNDS.out_mm))
        if part > BOUNDS.few:
            severity = "error" if part > BOUNDS.most else "warning"
            yield _find(code, muscle.name, part, *place, out.max(), severity=severity)

    def _attachments(self, muscle: Muscle) -> Iterator[Finding]:
        origin = muscle.origin[None]
        insertion = muscle.insertion[None]
        far = min(barycentric(origin, bone)[2][0] for bone in self.solid.values())
        if far > BOUNDS.origin_mm and in_front(self.template, origin).all():
            yield _find("muscle.origin", muscle.name, far)
        ends = (self.flesh, *self.solid.values())
        far = min(barycentric(insertion, end)[2][0] for end in ends)
        if far > BOUNDS.insertion_mm:
            yield _find("muscle.insertion", muscle.name, far)
        if (muscle.insertion - muscle.origin) @ muscle.fibre < 0:
            yield _find("muscle.fibre way", muscle.name)

    def _pairs(self, muscles: dict[str, Surface]) -> Iterator[Finding]:
        for name, surface in muscles.items():
            side = re.search(r"\b(left|right)\b|_[lr]$", name)
            if side is None:
                continue
            partner = name[: side.start()] + PARTNERS[side[0]] + name[side.end() :]
            if partner not in muscles:
                yield _find("muscle.pair missing", name, partner)
            elif side[0] in ("left", "_l"):
                yield from self._pair(name, surface, muscles[partner])

    def _pair(self, name: str, left: Surface, right: Surface) -> Iterator[Finding]:
        middles = [surface.vertices.mean(axis=0) for surface in (left, right)]
        if middles[0][0] < middles[1][0]:
            yield _find("muscle.side", name)
            return
        apart = float(np.linalg.norm(middles[0] * [-1, 1, 1] - middles[1]))
        if apart > BOUNDS.partner_mm:
            yield _find("muscle.pair place", name, apart)
        ratio = enclosed_volume(left) / max(enclosed_volume(right), 1e-9)
        if not 1 / BOUNDS.partner_volume < ratio < BOUNDS.partner_volume:
            yield _find("muscle.pair volume", name, ratio)


def _depths_of(bone: Surface, point: Floats, normal: Floats) -> tuple[float, float]:
    """Return how far in mm a bone is from a point of the skin, and how far along the normal.

    Tables measure across the skin (Stephan and Simpson 2008), which way that is on a slope differs.
    """
    near = float(barycentric(point[None], bone)[2][0])
    hits = igl.ray_mesh_intersect(point, -normal, bone.vertices, bone.faces)
    return near, float(hits[0][1]) if hits else near


def _edges_of_many_faces(surface: Surface) -> int:
    """Return how many edges belong to more than two triangles."""
    edges = np.sort(directed_edges(surface.faces), axis=1)
    return int(np.sum(np.unique(edges, axis=0, return_counts=True)[1] > 2))
