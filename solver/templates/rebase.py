"""Carry a template onto a studio's own base mesh, whose vertices become its skin.

The template is registered onto the head as onto a scan, and its bones, muscles and tets are carried
into that shape as into a person's. Regions, landmarks and shapes then go to the head's vertices by
:mod:`solver.registration.correspondence`, and these are bound to the tets as the template's were.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import igl
import numpy as np

from solver.anatomy.build import carry_anatomy
from solver.anatomy.contact_regions import contact_regions, eye_corners, stomia
from solver.anatomy.domain import MeshedFlesh
from solver.anatomy.embedding import barycentric
from solver.anatomy.meshing import bind_skin, find_or_make_mesh
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import ShapeBasis, Template
from solver.anatomy.transfer import carry_muscle, guidance, relax
from solver.errors import Finding, InputError
from solver.meshio.mesh import check_finite, too_large_error, weld
from solver.meshio.raw import RawScan, mend, read_raw
from solver.progress import ProgressCallback, Step, silent
from solver.registration.correspondence import Carrier, Correspondence, correspond
from solver.registration.landmarks import match, read_landmarks
from solver.registration.locate import face_surface
from solver.registration.register import RegisteredFace, register
from solver.registration.report import report
from solver.registration.scan_surface import sample, turned_outward
from solver.registration.search import face_points
from solver.registration.topology import Topology, topology
from solver.registration.units import AXES, FRAME
from solver.scans.cover import cover, has_second_face
from solver.scans.findings import cover_findings
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Ints, Surface, directed_edges


@dataclass(frozen=True)
class RebaseOptions:
    """Limits of a base mesh."""

    most_vertices: int = 100_000  # animators' heads have 5,000 to 50,000
    most_doubled: float = 0.2  # share of vertices in the place of another: triangles do not meet
    straight_deg: float = 20.0  # a head that is turned by less keeps its axes and origin ...
    centred_mm: float = 5.0  # ... if the middle of its face is so near to the plane x = 0
    mouth_mm: float = 6.0  # about the middle of the mouth lips may not hang together
    point_mm: float = 2.5  # most from a detector's point on the template to the head's skin


REBASE = RebaseOptions()


@dataclass(frozen=True)
class Rebased:
    """A template on a head's vertices, and how it came there."""

    template: Template
    registration: dict[str, Any]  # of the template as it was, as of a scan, and what the head lacks
    carry: Carrier  # of values of its vertices to those of the head
    turn: Similarity  # from its frame to that of the head


def rebase(
    template: Template,
    skin: Path,
    *,
    name: str = "",
    frame: Mapping[str, Any] = FRAME,
    landmarks: Path | None = None,
    progress: ProgressCallback = silent,
) -> Rebased:
    """Return the template with the vertices of the head ``skin``, in their order.

    ``frame`` and ``landmarks`` are those of a raw scan. A head that stands upright about x = 0
    keeps its own axes and origin; the unit becomes mm.

    Raises :class:`InputError`: ``scan.too_large``, ``scan.nan``, ``rebase.faces`` or
    ``rebase.doubled`` for what is no base mesh, ``scan.two_heads``, and as :func:`read_raw` and
    :func:`register`; :class:`SolveError` where no tets can be made.
    """
    raw = read_raw(skin)
    _check(raw)
    mesh = template.mesh or find_or_make_mesh(template, progress=progress).mesh
    template, known = replace(template, mesh=mesh), topology(template)
    face, findings = _register(raw, known, frame, landmarks, progress)
    head, own_axes = _place(raw, face, known)
    turn = own_axes or IDENTITY
    progress(Step("anatomy", 0.7))
    person, made_by = _into_shape(template, turn(face.skin.vertices))
    progress(Step("correspondence", 0.9))
    found = correspond(head, person)
    carry = found.carrier(len(person.skin.vertices))
    rebased = replace(
        _bind(_on_head(person, head, found, carry), person),
        name=name or f"{template.name}-{skin.stem}",
        source=f"{template.source}; skin: {raw.file}",
        shapes=_carry_shapes(template.shapes, carry, turn),
    )
    rebased = replace(rebased, points=_carry_points(person, rebased))
    if own_axes is None:
        message = "The head is not upright about x = 0: it was turned into the template's axes."
        findings.append(Finding("rebase.turned", "info", message))
    if made_by != "transport":
        findings.append(Finding("rebase.meshed", "info", f"The tetrahedra are new: {made_by}."))
    findings += _remarks(rebased, person, found)
    registration = report(face, known, face.start.size.taken_from)
    told = [finding.to_dict() for finding in findings] + registration["findings"]
    # advice is for who can scan again
    registration["findings"] = [finding | {"advice": ""} for finding in told]
    progress(Step("done", 1.0))
    return Rebased(rebased, registration, carry, turn)


def _check(raw: RawScan) -> None:
    """Raise what makes a mesh no skin of a template."""
    file = raw.file
    count = len(raw.vertices)
    if count > REBASE.most_vertices:
        raise too_large_error(file, "vertices", count, "a base mesh", REBASE.most_vertices)
    if not len(raw.faces):
        raise InputError("rebase.faces", f"{file} is a cloud of points, not a mesh", file=file)
    check_finite(file, raw.vertices)
    doubled = count - len(weld(raw.vertices)[0])
    if doubled > REBASE.most_doubled * count:
        reason = "its triangles do not share vertices; export it as OBJ"
        message = (
            f"{doubled} of the {count} vertices of {file} lie in the place of another: {reason}"
        )
        raise InputError("rebase.doubled", message, file=file, found=doubled)


def _register(
    raw: RawScan,
    known: Topology,
    frame: Mapping[str, Any],
    landmarks: Path | None,
    progress: ProgressCallback,
) -> tuple[RegisteredFace, list[Finding]]:
    """Register the template onto a head; return what the head lacks of a face, too."""
    template = known.template
    scan = mend(raw)[0]
    own = face_surface(template)
    samples = sample(scan.vertices, scan.faces, scan.normals)
    marks = None
    if landmarks is not None:
        marks = match(landmarks.name, read_landmarks(landmarks), template)
    face = register(scan, known, frame=frame, landmarks=marks, progress=progress)
    if has_second_face(samples, face_points(own), face.start.pose):
        raise InputError("scan.two_heads", f"{raw.file} holds two heads", file=raw.file)
    motion = replace(IDENTITY, scale=face.start.mm_per_unit).then(face.motion)
    seen = cover(samples.transform(motion), face.skin.vertices, template, own)
    return face, cover_findings(seen)


def _place(
    raw: RawScan, face: RegisteredFace, known: Topology
) -> tuple[Surface, Similarity | None]:
    """Return the head in mm, and the motion of the registered face to it.

    It is None where the head is turned into the template's axes.
    """
    start = face.start
    motion = face.motion
    surface = turned_outward(Surface(start.mm_per_unit * raw.vertices, raw.faces))
    up = np.array(AXES[start.up])
    forward = np.array(AXES[start.forward])
    axes = np.stack([np.cross(up, forward), up, forward])
    if axes[0].any():
        turned = axes @ motion.rotation.T
        back = Similarity(1.0, turned, -turned @ motion.shift)
        middle = float(back(face.skin.vertices[known.face])[:, 0].mean())
        if back.degrees < REBASE.straight_deg and abs(middle) < REBASE.centred_mm:
            return surface.with_vertices(motion.scale * surface.vertices @ axes.T), back
    return surface.with_vertices(motion(surface.vertices)), None


def _into_shape(template: Template, skin: Floats) -> tuple[Template, str]:
    """Return the template in the shape of ``skin`` (n, 3), and what made its tets.

    It is brought to the skin's place first, so that its planes are at theirs.
    """
    assert template.mesh is not None
    shift = (skin - template.skin.vertices)[template.face_vertices].mean(axis=0)

    def move(points: Floats) -> Floats:
        return np.asarray(points + shift)

    moved = replace(
        template,
        skin=template.skin.with_vertices(move(template.skin.vertices)),
        cranium=template.cranium.with_vertices(move(template.cranium.vertices)),
        mandible=template.mandible.with_vertices(move(template.mandible.vertices)),
        muscles=tuple(carry_muscle(muscle, move) for muscle in template.muscles),
        condyles=move(template.condyles),
        bottom_y=template.bottom_y + float(shift[1]),
        back_z=template.back_z + float(shift[2]),
        mesh=replace(template.mesh, vertices=move(template.mesh.vertices)),
    )
    return carry_anatomy(moved, skin, edge_mm=template.mesh.edge_mm)


def _carry_shapes(shapes: ShapeBasis | None, carry: Carrier, turn: Similarity) -> ShapeBasis | None:
    if shapes is None:
        return None
    identity, expressions = (
        np.array([carry(turn.turn(delta)) for delta in deltas], np.float32)
        for deltas in (shapes.identity, shapes.expressions)
    )
    return ShapeBasis(identity, expressions, shapes.expression_names)


def _carry_points(person: Template, based: Template) -> SkinPoints | None:
    """Return the detector's points of ``person`` on the skin of ``based``, where it has one there.

    The lips of both are parted, so that none comes onto the other lip.
    """
    points = person.points
    skin = based.parted_flesh
    if points is None:
        return None
    face, weights, away = barycentric(points.at(person.parted_skin.vertices), skin)
    kept = away < REBASE.point_mm
    names = tuple(name for name, is_kept in zip(points.names, kept, strict=True) if is_kept)
    return SkinPoints(skin.faces[face[kept]], weights[kept], names, points.spread_mm[kept])


def _on_head(person: Template, head: Surface, found: Correspondence, carry: Carrier) -> Template:
    """Return the anatomy of ``person`` with a head for its skin: sets of vertices, landmarks."""
    parts = found.parts

    def on_skin(vertices: Ints) -> Ints:
        return np.flatnonzero(found.among(vertices) & parts.skin)

    flesh = np.flatnonzero(parts.skin[head.faces].all(axis=1))
    with_mandible = np.union1d(np.flatnonzero(parts.lower), on_skin(person.attached_mandible))
    with_cranium = np.flatnonzero(~parts.skin & ~parts.lower)
    with_cranium = np.union1d(with_cranium, on_skin(person.attached_cranium))
    landmarks = found.landmarks(head, person)
    regions = {name: on_skin(vertices) for name, vertices in person.regions.items()}
    left = head.vertices[:, 0] > 0
    touching = {
        "upper_teeth": parts.teeth & ~parts.lower,
        "lower_teeth": parts.teeth & parts.lower,
        "left_eyeball": parts.eyes & left,
        "right_eyeball": parts.eyes & ~left,
    }
    regions |= {name: np.flatnonzero(part) for name, part in touching.items()}
    own = {name: regions[name] for name in touching}
    if all(map(len, own.values())) and len(eye_corners(landmarks)) == 2:
        skin = Surface(head.vertices, head.faces[flesh])
        regions |= contact_regions(skin, found.sides, own, landmarks)
    return replace(
        person,
        skin=head,
        flesh_faces=flesh,
        face_vertices=on_skin(person.face_vertices),
        attached_cranium=np.setdiff1d(with_cranium, with_mandible),
        attached_mandible=with_mandible,
        parting=carry(person.parting),
        bottom_y=max(person.bottom_y, float(head.vertices[parts.skin, 1].min()) - 1.0),
        landmarks=landmarks,
        regions={name: vertices for name, vertices in regions.items() if len(vertices)},
        depths=tuple(depth for depth in person.depths if depth.landmark in landmarks),
        texture=None,  # of another skin
    )


def _bind(template: Template, person: Template) -> Template:
    """Return the template with its skin bound to the tets of ``person``, with parted lips."""
    mesh = person.mesh
    assert mesh is not None
    held = np.concatenate([mesh.cranium, mesh.mandible, mesh.cut])
    parted = person.parted_skin.vertices
    place = mesh.vertices[held]
    rows = mesh.surface_rows
    start = mesh.vertices
    guides = guidance(person, parted, mesh.embedded, rows, held, place, start)
    facets, owners, _ = igl.boundary_facets(mesh.tets)
    outside = ~np.isin(facets, held).all(axis=1)
    flesh = MeshedFlesh(
        relax(start, mesh.tets, guides), mesh.tets, facets[outside], owners[outside], {}
    )
    embedded, tet, shares, on_jaw = bind_skin(template, flesh, mesh.edge_mm)
    bound = replace(
        mesh, embedded=embedded, embedded_in=tet, shares=shares, attached_mandible=on_jaw
    )
    face = np.intersect1d(template.face_vertices, embedded)
    return replace(template, face_vertices=face, mesh=bound)


def _remarks(based: Template, person: Template, found: Correspondence) -> Iterator[Finding]:
    """Yield what the head lacks: eyes, teeth, a mouth that opens."""
    parts = found.parts
    lacking = [name for name in ("eyes", "teeth") if not getattr(parts, name).any()]
    if lacking:
        message = f"It has no {' and no '.join(lacking)}: rigs show none, and no skin meets them."
        yield Finding("rebase.parts", "info", message)
    skin = based.skin.vertices
    flesh = based.flesh.faces
    middle = stomia(person.landmarks)
    edges = directed_edges(flesh)
    across = edges[found.sides[edges].prod(axis=1) < 0]
    if middle and len(across):
        mouth = person.skin.vertices[middle].mean(axis=0)
        off = np.linalg.norm(skin[across].mean(axis=1) - mouth, axis=1)
        if (off < REBASE.mouth_mm).any():
            one, other = across[off.argmin()].tolist()
            message = (
                f"The lips hang together, as at vertices {one} and {other}: the skin between them "
                "is stretched where the mouth opens."
            )
            yield Finding("rebase.mouth", "warning", message, context={"vertex": one})
