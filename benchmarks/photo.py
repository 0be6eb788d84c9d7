"""Photographs: how near a face comes to the one that was photographed.

`known` draws mixtures of a subject's shapes by another light than a fit supposes (dozens of lamps
and their shadows, skin with blotches and freckles), spoils pixels and landmarks with noise, and
fits tracks (T) and plain shapes (B) by landmarks alone and by shading, too; the camera is unknown.
The head's motion is taken out of the distances: a picture does not tell how far away a head is.
`held_out` fits the photographs of a folder, each with every fourth landmark that was found left
out, and tells how far off these are, in parts of the distance of the outer corners of the eyes:
on the subject's face, and on one that is estimated from the same landmarks (`estimated`).
`pair` fits a real pair of photographs of a face at rest whose scan is known, with that scan's own
model: whatever moves is invented.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.photo_pair import pair_figures, read_pair
from benchmarks.simulated_targets import both_sides
from benchmarks.subjects import COARSE_EDGE_MM, Subject
from benchmarks.systems import MIXTURES, QUICK_MIXTURES
from solver.anatomy.build import build_subject_model
from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.drawing.render import GAMMA, irradiance, rasterise
from solver.errors import InputError
from solver.landmarker import landmarker_file
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.photo.camera import PinholeCamera
from solver.photo.detect import find_face
from solver.photo.expression import fit_expression
from solver.photo.fit import PhotoPoint
from solver.photo.identity import fit_identity
from solver.photo.mesh_points import landmark_points
from solver.photo.photo import Photo
from solver.photo.read import read_photo
from solver.registration.detector import FaceDetector
from solver.similarity import small_motion, weighted_motion
from solver.surface import Floats, Surface, adjacency, vertex_normals
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import ShapeFace
from solver.tracks.plain import PlainFace
from solver.tracks.shapes import template_shapes

PARTS = ("known", "pair")
SYSTEMS = ("B", "T")
EYE_CORNERS = ("33", "263")
HELD_OUT = 4  # one landmark of so many

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Plate:
    """A picture that is drawn: its camera, the skin's colours and the noise."""

    size: tuple[int, int] = (540, 720)  # px
    focal_px: float = 1400.0
    distance_mm: float = 650.0
    turn_deg: tuple[float, float] = (5.0, 25.0)  # pitch and yaw of the head
    skin: tuple[float, float, float] = (0.62, 0.43, 0.34)  # mean albedo, linear RGB
    blotches: float = 0.08  # standard deviation of wide and of fine changes of it
    freckles: float = 0.04
    exposure: float = 0.6
    noise: float = 2 / 255  # of each channel, sRGB
    landmark_px: float = 2.0  # of each coordinate
    seed: int = 4


PLATE = Plate()


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--edge-mm", type=float, default=COARSE_EDGE_MM, help="of the tets")
    parser.add_argument(
        "--scan", type=Path, help="OBJ of a pair, its picture beside it, for `pair`"
    )
    parser.add_argument("--photos", type=Path, help="a folder of pictures, for `held_out`")
    report.add_list(parser, "--parts", PARTS)
    report.add_list(parser, "--systems", SYSTEMS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen subject."""
    subject = next(subjects.each(options, [options.subject], options.edge_mm))
    template = subjects.chosen_template(options, options.edge_mm)
    points = landmark_points(template)
    shapes = template_shapes(subject.model, subjects.shapes(options))
    faces = {name: _face(name, subject.model, shapes) for name in options.systems}
    found: Figures = {
        "edge_mm": options.edge_mm,
        "subject": subject.name,
        "points": len(points.names),
    }
    if "known" in options.parts:
        found["known"] = _known(subject, shapes, faces, points, quick=options.quick)
    if "pair" in options.parts:
        found["pair"] = _pair(options.scan, template, points, options)
    if options.photos is not None:
        found["held_out"] = _held_out(options, template, faces, points)
    return found


def _face(system: str, model: SubjectModel, shapes: Mapping[str, Floats]) -> ShapeFace[Any]:
    tracks = MuscleTracks.of(model, shapes)
    if system == "B":
        return PlainFace(model, tracks)
    return TrackFace(model, tracks, track_potentials(model), linear=fastest())


def _known(
    subject: Subject,
    shapes: Mapping[str, Floats],
    faces: Mapping[str, ShapeFace[Any]],
    points: SkinPoints,
    *,
    quick: bool,
) -> Figures:
    model = subject.model
    random = np.random.default_rng(PLATE.seed)
    camera = _camera(model.skin.vertices, model.face)
    albedo = _albedo(model.skin, random)
    found: dict[str, dict[str, Figures]] = {}
    for name in list(MIXTURES)[: QUICK_MIXTURES if quick else None]:
        weights = both_sides(MIXTURES[name])
        skin = model.skin.vertices + sum(part * shapes[each] for each, part in weights.items())
        photo = _draw(name, model.skin.with_vertices(skin), camera, albedo, points, random)
        for system, face in faces.items():
            begun = time.perf_counter()
            fitted = fit_expression(face, [photo], points)
            figures = {
                "neutral_mm": _off(model.skin.vertices, skin, model.face),
                "landmarks_mm": _off(fitted.landmarks.point.skin, skin, model.face),
                "shading_mm": _off(fitted.fit.point.skin, skin, model.face),
                "seconds": time.perf_counter() - begun,
            }
            log.info("%s by %s: %s", name, system, figures)
            found.setdefault(system, {})[name] = figures
    return {
        system: {**_means(list(each.values())), "targets": each} for system, each in found.items()
    }


def _means(targets: list[Figures]) -> Figures:
    return {key: float(np.mean([each[key] for each in targets])) for key in targets[0]}


def _camera(neutral: Floats, face: np.ndarray) -> PinholeCamera:
    pitch, yaw = np.radians(PLATE.turn_deg)
    turn = small_motion(np.array([pitch, yaw, 0.0, 0.0, 0.0, 0.0])).rotation
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    shift = np.array([10.0, -5.0, PLATE.distance_mm]) - rotation @ neutral[face].mean(axis=0)
    focal = np.full(2, PLATE.focal_px)
    centre = np.array(PLATE.size) / 2.0
    return PinholeCamera(focal, centre, rotation, shift)


def _albedo(skin: Surface, random: np.random.Generator) -> Floats:
    """Return the skin's albedo (V, 3), linear RGB, with blotches and freckles."""
    links = adjacency(skin.faces, len(skin.vertices))
    count = np.maximum(links.sum(axis=1), 1.0)
    changes = np.ones(len(skin.vertices))
    for strength, rounds in ((PLATE.blotches, 30), (PLATE.freckles, 2)):
        field = random.standard_normal(len(skin.vertices))
        for _ in range(rounds):
            field = 0.5 * field + 0.5 * (links @ field) / count
        changes += strength * field / field.std()
    return np.asarray(changes[:, None] * np.array(PLATE.skin))


def _draw(
    name: str,
    skin: Surface,
    camera: PinholeCamera,
    albedo: Floats,
    points: SkinPoints,
    random: np.random.Generator,
) -> Photo:
    colours = PLATE.exposure * albedo * irradiance(skin, vertex_normals(skin))
    width, height = PLATE.size
    seen = rasterise(camera.project(skin.vertices), skin.faces, width, height)
    pixels = np.zeros((height, width, 3))
    pixels[seen.mask] = np.clip(seen.interpolate(colours), 0.0, 1.0)
    spoilt = pixels ** (1.0 / GAMMA) + PLATE.noise * random.standard_normal(pixels.shape)
    places = camera.project(points.at(skin.vertices))[:, :2]
    places = places + PLATE.landmark_px * random.standard_normal(places.shape)
    marks = {n: each for n, each in zip(points.names, places, strict=True) if n.isdigit()}
    bytes_ = np.round(255 * np.clip(spoilt, 0.0, 1.0))
    return Photo(name, (bytes_ / 255).astype(np.float32), landmarks=marks)


def _off(skin: Floats, truth: Floats, face: np.ndarray) -> float:
    motion = weighted_motion(skin[face], truth[face], np.ones(len(face)))
    return float(np.linalg.norm(motion(skin[face]) - truth[face], axis=1).mean())


def _held_out(
    options: argparse.Namespace,
    template: Template,
    faces: Mapping[str, ShapeFace[Any]],
    points: SkinPoints,
) -> dict[str, dict[str, Figures]]:
    """Return system -> photograph -> figures; those in which no face can be used are told."""
    found: dict[str, dict[str, Figures]] = {}
    shapes = subjects.shapes(options)
    for photo in _read(options.photos):
        names = [name for name in points.names if name in photo.landmarks]
        hidden = names[::HELD_OUT]
        shown = replace(
            photo, landmarks={n: p for n, p in photo.landmarks.items() if n not in hidden}
        )
        eyes = float(np.linalg.norm(np.subtract(*(photo.landmarks[n] for n in EYE_CORNERS))))
        given = np.array([photo.landmarks[name] for name in hidden])
        neutral = fit_identity(template, [shown], points).neutral
        estimate = build_subject_model(template, neutral, edge_mm=options.edge_mm)
        for system, face in faces.items():
            begun = time.perf_counter()
            fitted = fit_expression(face, [shown], points)
            seconds = time.perf_counter() - begun
            own = _face(system, estimate, template_shapes(estimate, shapes))
            estimated = fit_expression(own, [shown], points).fit.point
            off = {
                stage: 100 * _pixels_off(each, given, points.select(hidden)) / eyes
                for stage, each in (
                    ("landmarks", fitted.landmarks.point),
                    ("shading", fitted.fit.point),
                    ("estimated", estimated),
                )
            }
            figures = {
                **{f"{stage}_percent": value for stage, value in off.items()},
                "seconds": seconds,
            }
            log.info("%s by %s: %s", photo.name, system, figures)
            found.setdefault(system, {})[photo.name] = figures
    return found


def _pair(
    scan: Path | None, template: Template, points: SkinPoints, options: argparse.Namespace
) -> Figures:
    """Return the figures of a real pair, or why there are none."""
    file = landmarker_file()
    if scan is None or not scan.is_file() or file is None:
        log.info("pair skipped: it asks for --scan and a face landmarker")
        return {"skipped": "no scan of a pair, or no face landmarker"}
    with FaceDetector(file) as detector:
        pair = read_pair(scan, template, options.edge_mm, detector)
    shapes = template_shapes(pair.model, template.shapes)
    faces = {name: _face(name, pair.model, shapes) for name in options.systems}
    return pair_figures(pair, template, faces, points)


def _pixels_off(point: PhotoPoint[Any], given: Floats, points: SkinPoints) -> float:
    places = point.cameras[0].project(points.at(point.skin))[:, :2]
    return float(np.linalg.norm(places - given, axis=1).mean())


def _read(folder: Path) -> Iterator[Photo]:
    """Give the photographs of a folder with the landmarks of their largest faces."""
    file = landmarker_file()
    if file is None:
        raise SystemExit("held_out asks for MediaPipe and its model in MYOFACE_FACE_LANDMARKER")
    with FaceDetector(file) as detector:
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() in (".jpg", ".jpeg", ".png"):
                photo = read_photo(path)
                try:
                    face = find_face(photo, detector)
                except InputError as error:
                    log.info("%s left out: %s", path.name, error)
                    continue
                yield replace(photo, landmarks=face.landmarks)


COLUMNS = {
    "neutral_mm": "neutral, mm",
    "landmarks_mm": "landmarks, mm",
    "shading_mm": "with shading, mm",
    "seconds": "s",
}

PAIR_COLUMNS = {
    "shading_mm": "moved, mm",
    "shading_grown_mm": "further from the scan, mm",
    "shading_weights": "sum of weights",
}


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts: list[Table | str] = []
    if "known" in figures:
        rows = [
            [system, *(round(float(each[key]), 2) for key in COLUMNS)]
            for system, each in figures["known"].items()
        ]
        parts.append(Table(["", *COLUMNS.values()], rows))
    if fits := figures.get("pair", {}).get("fits"):
        rows = [
            [name, *(round(float(each[key]), 2) for key in PAIR_COLUMNS)]
            for name, each in fits.items()
        ]
        parts.append(Table(["pair at rest", *PAIR_COLUMNS.values()], rows))
    if estimates := figures.get("pair", {}).get("estimates"):
        rows = [[name, *(round(v, 2) for v in one.values())] for name, one in estimates.items()]
        columns = ["median to the scan, mm", "resized, mm"]
        parts.append(Table(["face estimated from the pair", *columns], rows))
    for system, each in figures.get("held_out", {}).items():
        rows = [[name, *(round(float(v), 2) for v in one.values())] for name, one in each.items()]
        columns = ["landmarks, %", "with shading, %", "face estimated, %", "s"]
        parts.append(Table([system, *columns], rows))
    return Section(
        "Photographs",
        "Distances of the face to the one that was drawn, the head's motion apart, means of the "
        "mixtures (`known`); distances of landmarks left out, in parts of the distance of the "
        "outer corners of the eyes (`held_out`); what fits make of a real face at rest (`pair`).",
        parts,
    )


if __name__ == "__main__":
    main()
