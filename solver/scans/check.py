"""The ingest check: what is in a raw scan, and what is wrong with it.

Within seconds: the file and its mesh, the face's place, unit and axes, what is missing of it, how
noisy it is, mouth and eyes, landmarks. A bad scan is no exception but a verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from solver.anatomy.template import Template
from solver.drawing.render import Camera, Pixels, look
from solver.drawing.sheet import HEADER, PAPER, Sheet
from solver.errors import Finding, InputError
from solver.meshio.raw import RawScan, mend, read_raw
from solver.meshio.scan_archive import opened_scan
from solver.model import SIZE_WORDS
from solver.registration.locate import (
    Location,
    around,
    face_surface,
    likely_scales,
    locate_face,
    location_findings,
)
from solver.registration.scan_surface import estimated_normals, sample
from solver.registration.search import face_points
from solver.registration.shape_fit import lid_shapes
from solver.registration.units import check_frame
from solver.scans.cover import FAR_MM, Cover, cover, has_second_face, visible_part
from solver.scans.findings import (
    axis_findings,
    cover_findings,
    error_finding,
    feature_findings,
    file_findings,
    landmark_findings,
    make_finding,
    roughness_findings,
    winding_findings,
    with_advice,
)
from solver.scans.mouth import Eye, MouthGaps, find_eyes, find_mouth, roughness, spikes
from solver.surface import Floats, Surface, area_normals, unit_rows, vertex_normals

# Assessment of a scan part by part: those that a check could judge, and those it could not. A
# finding says what is wrong; where there is none, these words tell a part that is right from one
# that nobody looked at.


@dataclass(frozen=True)
class Assessment:
    """A part of a scan, and whether it was judged."""

    about: str
    judged: bool
    words: str

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain JSON values."""
        return asdict(self)


@dataclass(frozen=True)
class FaceDetail:
    """Cover, roughness, mouth and eyes of the face in a scan."""

    cover: Cover
    noise_mm: float  # NaN in a scan too coarse to tell
    spacing_mm: float
    mouth: MouthGaps
    eyes: dict[str, Eye]


def assess(
    scan: RawScan, place: Location, detail: FaceDetail, *, marked: bool
) -> Iterator[Assessment]:
    """Yield the parts of a scan; ``marked`` says whether it has landmarks."""
    size = place.size
    words = f"read {size.unit.words}, {size.words}" if size.is_known else SIZE_WORDS["template"]
    yield Assessment("size", size.is_known, words)
    share = detail.cover.share()
    yield Assessment("cover", True, f"{share:.1%} of the face is in the scan")
    is_dense = not np.isnan(detail.noise_mm)
    spaced = f"a vertex every {detail.spacing_mm:.1f} mm on the face"
    noise = f"{detail.noise_mm:.2f} mm, {spaced}" if is_dense else f"{spaced} is too few to tell"
    yield Assessment("noise", is_dense, noise)
    yield _eyes(detail.eyes)
    yield from _mouth(detail.mouth)
    tells = marked or (scan.normals is not None and len(scan.faces) > 0)
    words = "by the landmarks" if marked else "by the stored normals"
    unknown = "without stored normals or landmarks a mirrored face looks like another person's"
    yield Assessment("mirroring", tells, words if tells else unknown)


def _eyes(eyes: dict[str, Eye]) -> Assessment:
    unseen = {side: eye for side, eye in eyes.items() if eye.closed is None}
    if not eyes:
        return Assessment("eyes", False, "the template does not name their corners")
    if not unseen:
        shut = [side for side, eye in eyes.items() if eye.closed]
        words = "open" if not shut else "closed" if len(shut) == 2 else f"the {shut[0]} one closed"
        return Assessment("eyes", True, words)
    which = "both" if len(unseen) == 2 else f"the {next(iter(unseen))} one"
    return Assessment("eyes", False, f"{which}: {next(iter(unseen.values())).why_not}")


def _mouth(mouth: MouthGaps) -> Iterator[Assessment]:
    if mouth.lips_mm is None:
        yield Assessment("lips", False, mouth.why_not)
    else:
        words = f"{mouth.lips_mm:.0f} mm apart" if mouth.lips_mm else "closed"
        yield Assessment("lips", True, words)
    if mouth.teeth_mm is not None:
        yield Assessment("teeth", True, f"{mouth.teeth_mm:.0f} mm apart")
    else:
        words = "between the lips" if mouth.is_open else "behind closed lips"
        yield Assessment("teeth", False, f"{words} it does not show whether they are apart")


# Margins below and above the face along x, y, z: of the part that is looked at closely, and of the
# head without neck and shoulders.
AROUND_HEAD_MM = np.array([[40.0, 10.0, 60.0], [40.0, 70.0, 40.0]])


@dataclass
class ScanCheck:
    """The findings of a check, its figures, and what its picture shows."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    parts: list[Assessment] = field(default_factory=list)
    scan: RawScan | None = None  # mended; None if it cannot be read
    location: Location | None = None  # of its face, if there is one
    cover: Cover | None = None  # what is missing of the face
    marked: NDArray[np.bool_] | None = None  # (n,) vertices of the scan with a fault


def check(
    path: Path, template: Template, frame: Mapping[str, Any], role: str, landmarks: Path | None
) -> ScanCheck:
    """Check the raw scan at ``path``; ``frame`` as :func:`locate_face` takes it.

    ``role`` is ``neutral``, ``expression`` or ``unknown``: an open mouth or closed eyes are only
    wrong in a neutral. Raises :class:`InputError` only for options that do not exist.
    """
    check_frame(frame)
    result = ScanCheck()
    try:
        _check(result, path, template, frame, role, landmarks)
    except InputError as error:
        result.findings.append(error_finding(error))
    return result


def _check(
    result: ScanCheck,
    path: Path,
    template: Template,
    frame: Mapping[str, Any],
    role: str,
    landmarks: Path | None,
) -> None:
    """Fill ``result``; raises :class:`InputError` for a scan that cannot be looked at."""
    with opened_scan(path) as file:
        raw = read_raw(file)
    scan, mending = mend(raw)
    result.findings += file_findings(raw, mending)
    result.figures |= {"vertices": len(raw.vertices), "triangles": len(raw.faces)}
    if len(scan.vertices) < 100 or (len(raw.faces) and not len(scan.faces)):
        raise InputError("scan.empty", f"{raw.file} holds no surface", file=raw.file)
    samples = sample(scan.vertices, scan.faces, scan.normals)
    surface = face_surface(template)
    face = face_points(surface)
    marking: list[Finding] = []
    marks = None
    if landmarks is not None:
        marking, marks = landmark_findings(landmarks, template, scan, samples, frame)
    place = locate_face(scan, samples, template, frame, marks)
    result.scan = scan
    result.figures |= {
        "coverage": round(place.pose.coverage, 3),
        "likeness_mm": round(place.pose.residual_mm, 2),
    }
    result.findings += [with_advice(found) for found in location_findings(scan, place, frame)]
    if not place.is_face:
        part = visible_part(samples, surface, likely_scales(scan, samples, frame))
        if part is not None:
            message = f"{scan.file} shows only the {part} half of a face."
            half = make_finding("scan.half_face", "error", message, part=part)
            others = (found for found in result.findings if found.code != "scan.not_a_face")
            result.findings = [*others, half]
        return
    result.location = place
    result.figures |= {
        **place.size.figures,
        "up": place.up,
        "forward": place.forward,
        "size": round(place.size.share, 3),
    }
    result.findings += axis_findings(place, frame)
    if has_second_face(samples, face, place.pose):
        message = f"{scan.file} shows two heads."
        result.findings.append(make_finding("scan.two_heads", "error", message))
    winding = winding_findings(scan, samples, face, place)
    result.findings += _judge_winding(winding, marking, known=landmarks is not None)
    detail = _look_closer(result, scan, place, template, surface, role)
    result.parts = list(assess(scan, place, detail, marked=marks is not None))


def _judge_winding(winding: list[Finding], marking: list[Finding], *, known: bool) -> list[Finding]:
    """Return the findings of winding and landmarks; ``known`` says whether there are landmarks.

    Landmarks are set on the scan as it is seen. If their sides are exchanged and the triangles
    face inwards too, it is the scan that is mirrored; if only the triangles do, it is not.
    """
    others = [finding for finding in winding if finding.code != "scan.mirrored"]
    if not known or len(others) == len(winding):
        return marking + winding
    if any(finding.code == "landmarks.swapped" for finding in marking):
        message = "The scan is mirrored: its triangles face inwards, left and right are exchanged."
        return [make_finding("scan.mirrored", "error", message)]
    return marking + others


def _look_closer(
    result: ScanCheck, scan: RawScan, place: Location, template: Template, face: Surface, role: str
) -> FaceDetail:
    """Add what the face lacks, its noise and spikes, its mouth and eyes."""
    fitted = place.likeness
    assert fitted is not None, "a face has a likeness"
    motion = fitted.motion
    size = place.mm_per_unit / motion.scale
    seen = cover(place.near.transform(motion), fitted.vertices, template, face)
    vertices = motion(scan.vertices)
    noise_mm, spacing_mm = roughness(vertices * size, seen.points[seen.covered] * size)
    marked = np.zeros(len(vertices), bool)
    if len(scan.faces):
        marked = spikes(vertices * size, scan.faces) & around(vertices, face, AROUND_HEAD_MM)
    surface = Surface(vertices, scan.faces)
    mouth = find_mouth(surface, template)
    eyes = find_eyes(surface, fitted.vertices, template)
    if mouth.is_open:
        seen = seen.without_mouth()
    result.findings += cover_findings(seen)
    result.findings += roughness_findings(noise_mm, spacing_mm, int(marked.sum()))
    opens = bool(lid_shapes(template.shapes))
    result.findings += feature_findings(mouth, eyes, role, opens=opens)
    result.cover = seen
    result.marked = marked
    result.figures |= {
        "covered": round(seen.share(), 3),
        "noise_mm": None if np.isnan(noise_mm) else round(noise_mm, 2),
        "spacing_mm": round(spacing_mm, 2),
        "lip_gap_mm": mouth.lips_mm,
        "spikes": int(marked.sum()),
    }
    return FaceDetail(seen, noise_mm, spacing_mm, mouth, eyes)


# The picture of a check: the scan from the front and from both sides, its faults in colour.


WIDTH = 420  # pixels of a view
HEIGHT = 520  # pixels of a view
SUPERSAMPLING = 2  # pixels drawn for one that is kept, along each axis
YAWS = (0.0, np.radians(42), np.radians(-42))  # of the views
SPAN_MM = 330.0  # height of a view
GREY = np.array([0.80, 0.78, 0.76])  # skin
INWARD = np.array([0.45, 0.52, 0.66])  # triangles that face inwards
FAULT = np.array([0.93, 0.55, 0.10])  # spikes
MISSING = np.array([0.86, 0.10, 0.12])  # of the face
BACKGROUND = np.array(PAPER) / 255
SCANNED = "the scan"
SPIKES = "spikes"
NOT_SCANNED = "of the face, not in the scan"
INNER_SIDE = "the surface from its inner side"
LEGEND = {SCANNED: GREY, NOT_SCANNED: MISSING, SPIKES: FAULT, INNER_SIDE: INWARD}
MOST_POINTS = 100_000  # of a cloud that are drawn
LARGEST_DISC = 8  # pixels, radius
MISSING_PIXELS = 8  # radius of a disc where the face is missing
# What is missing is drawn where the fitted face has it, even if the scan lies before it.
BEHIND_MM = 25.0
BACK_MM = 45.0  # of the view's middle behind the face


def check_picture(check: ScanCheck, title: str, path: Path) -> None:
    """Write the picture of a check as PNG: three views, their colours explained below.

    Without a scan the picture holds only the title.
    """
    seen: set[str] = set()
    views = []
    if check.scan is not None:
        scan = _place(check)
        views = [_view(check, scan, yaw, seen) for yaw in YAWS]
    legend = {words: tuple(colour) for words, colour in LEGEND.items() if words in seen}
    not_judged = ", ".join(each.about for each in check.parts if not each.judged)
    detail = f"not judged: {not_judged}" if not_judged else ""
    if views and check.location is None:
        detail = "no face was found: nothing is marked"
    page = Sheet.with_legend(title, detail, legend, WIDTH * len(YAWS), HEADER + HEIGHT + 12)
    for number, view in enumerate(views):
        page.panel((WIDTH * number, HEADER), view)
    page.save(path)


@dataclass(frozen=True)
class _ShownScan:
    """A scan as it is to be seen, the middle (3,) of the view and its height."""

    surface: Surface
    centre: Floats
    span: float

    @cached_property
    def normals(self) -> Floats:
        """The unit normals (n, 3) of its vertices."""
        return vertex_normals(self.surface)


def _view(check: ScanCheck, scan: _ShownScan, yaw: float, seen: set[str]) -> Pixels:
    """Return a picture; the words of :data:`LEGEND` for its colours are added to ``seen``."""
    surface = scan.surface
    camera = Camera(scan.centre, scan.span, yaw, distance=FAR_MM)
    wide = WIDTH * SUPERSAMPLING
    high = HEIGHT * SUPERSAMPLING
    image = np.broadcast_to(BACKGROUND, (high, wide, 3)).copy()
    depth = np.full((high, wide), np.inf)
    if len(surface.faces):
        seen |= _draw_mesh(image, depth, camera, scan, check)
    else:
        _draw_cloud(image, depth, camera, surface.vertices)
        seen.add(SCANNED)
    if check.cover is not None and not check.cover.covered.all():
        missing = check.cover.points[~check.cover.covered]
        red = np.broadcast_to(MISSING, missing.shape)
        pixels = camera.project(missing, wide, high)
        _draw_discs(image, depth + BEHIND_MM, pixels, red, MISSING_PIXELS)
        seen.add(NOT_SCANNED)
    image = image.reshape(HEIGHT, SUPERSAMPLING, WIDTH, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(image, 0.0, 1.0), np.float32)


def _place(check: ScanCheck) -> _ShownScan:
    """Return the scan of a check as it is to be seen."""
    scan = check.scan
    assert scan is not None
    if check.location is None or check.cover is None:
        low, high = np.quantile(scan.vertices, [0.002, 0.998], axis=0)
        scale = SPAN_MM / 1.2 / float((high - low).max() + 1e-30)
        vertices = (scan.vertices - (low + high) / 2) * scale
        return _ShownScan(Surface(vertices, scan.faces), np.zeros(3), SPAN_MM)
    surface = Surface(check.location.pose.motion(scan.vertices), scan.faces)
    if any(finding.code == "scan.two_heads" for finding in check.findings):
        low, high = np.quantile(surface.vertices, [0.002, 0.998], axis=0)
        return _ShownScan(surface, (low + high) / 2, 1.6 * float((high - low).max()))
    middle = np.median(check.cover.points, axis=0) - np.array([0.0, 0.0, BACK_MM])
    return _ShownScan(surface, middle, SPAN_MM)


def _draw_mesh(
    image: Floats, depth: Floats, camera: Camera, scan: _ShownScan, check: ScanCheck
) -> set[str]:
    """Draw the scan, and return the words of :data:`LEGEND` for its colours."""
    surface = scan.surface
    seen = look(camera, surface, image.shape[1], image.shape[0])
    mask = np.asarray(seen.mask)
    if not mask.any():
        return set()
    shown_faces = surface.faces[seen.triangle[mask]]
    normals = unit_rows(area_normals(surface.vertices, shown_faces))
    normal = unit_rows(seen.interpolate(scan.normals).astype(np.float64))
    facing = normals @ camera.axes[2]
    light = camera.brightness(normal)
    inward = facing < 0
    colour = np.where(inward[:, None], INWARD, GREY)
    shown = {SCANNED, INNER_SIDE} if inward.any() else {SCANNED}
    if check.marked is not None and check.marked.any():
        fault = np.asarray(check.marked[surface.faces].any(axis=1))[seen.triangle[mask]]
        colour[fault] = FAULT
        if fault.any():
            shown.add(SPIKES)
    image[mask] = colour * (0.25 + 0.75 * light[:, None])
    place = seen.interpolate(surface.vertices).astype(np.float64)
    depth[mask] = camera.distance - (place - camera.centre) @ camera.axes[2]
    return shown


def _draw_cloud(image: Floats, depth: Floats, camera: Camera, points: Floats) -> None:
    """Draw a point cloud as a closed surface: discs as wide as the points lie apart."""
    shown = points[np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]]
    gap = float(np.median(KDTree(shown).query(shown[::7], k=2)[0][:, 1]))
    pixels = camera.project(shown, image.shape[1], image.shape[0])
    radius = round(2.0 * gap * image.shape[0] / camera.span)
    light = camera.brightness(estimated_normals(shown, shown))
    _draw_discs(image, depth, pixels, GREY * (0.25 + 0.75 * light[:, None]), radius)


def _draw_discs(image: Floats, depth: Floats, pixels: Floats, colours: Floats, radius: int) -> None:
    """Draw points (n, 3: column, row, depth) as discs, the nearest over all others."""
    rows, columns = depth.shape
    radius = int(np.clip(radius, 2, LARGEST_DISC))
    for down, right in product(range(-radius, radius + 1), repeat=2):
        if down * down + right * right <= radius * radius:
            column = np.rint(pixels[:, 0]).astype(int) + right
            row = np.rint(pixels[:, 1]).astype(int) + down
            inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
            # of several points in a pixel, the last written stays
            order = np.flatnonzero(inside)[np.argsort(-pixels[inside, 2])]
            kept = order[pixels[order, 2] < depth[row[order], column[order]]]
            image[row[kept], column[kept]] = colours[kept]
            depth[row[kept], column[kept]] = pixels[kept, 2]
