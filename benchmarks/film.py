"""Films: how well, how steadily and how fast a face is followed from frame to frame.

`known` moves a subject's shapes and head in front of a camera that nobody knows. Landmarks are off
by what stays from frame to frame, as a detector's bias does, and by what does not; at the end all
stands still. The head's motion is taken out of the distances. `films` fits the films of a folder,
each with every fourth landmark that was found left out, and tells how far off these are, in parts
of the distance of the outer corners of the eyes; and it fits a frame of each that is repeated with
a sensor's noise, in which the detector looks for the face anew. Jitter is how far places on the
skin stray in the picture while nothing moves: root mean square, px.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, Subject
from solver.anatomy.skin_points import SkinPoints
from solver.errors import InputError
from solver.kinds.inputs import FILMS
from solver.landmarker import landmarker_file
from solver.mechanics.linear import fastest
from solver.photo.camera import PinholeCamera
from solver.photo.expression import ExpressionOptions, ShadingOptions
from solver.photo.film import FilmOptions, FilmTracker, find_focal
from solver.photo.film_marks import find_marks
from solver.photo.fit import PhotoPoint
from solver.photo.footage import FilmFile, Footage
from solver.photo.mesh_points import landmark_points
from solver.photo.photo import Photo
from solver.registration.detector import EYE_CORNERS
from solver.similarity import small_motion, weighted_motion
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import ShapeFace
from solver.tracks.plain import PlainFace
from solver.tracks.shapes import template_shapes

SYSTEMS = ("B", "T")
HELD_OUT = 4  # one landmark of so many
SETTLED = 4  # still frames after which a face has come to rest

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Take:
    """A film that is made: motion, camera and the landmarks' errors."""

    moving: int = 24  # frames
    still: int = 12  # after these
    quick: int = 6  # of each, in a quick run
    size: tuple[int, int] = (540, 720)  # px
    focal_px: float = 1400.0
    distance_mm: float = 650.0
    turn_deg: tuple[float, float] = (4.0, 15.0)  # pitch and yaw of the head at the ends
    # of the shapes at the height of their motion, and how often they come in the moving frames
    weights: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: {
            "mouthSmileLeft": (0.8, 1.0),
            "mouthSmileRight": (0.8, 1.0),
            "jawOpen": (0.4, 2.0),
            "browInnerUp": (0.6, 0.5),
        }
    )
    bias_px: float = 2.0  # of each landmark's coordinates, the same in all frames
    noise_px: float = 0.5  # anew in each
    sensor: float = 2 / 255  # of each channel of a frame that is repeated, sRGB
    seed: int = 4


TAKE = Take()


@dataclass(frozen=True)
class Followed:
    """What is known of one frame once it was fitted; None where no face is."""

    seconds: float
    point: PhotoPoint[Any] | None


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--edge-mm", type=float, default=COARSE_EDGE_MM, help="of the tets")
    parser.add_argument("--films", type=Path, help="a folder of films, for `films`")
    parser.add_argument("--frames", type=int, default=48, help="of each film at most")
    parser.add_argument("--shading", action="store_true", help="compare the skin's light, too")
    report.add_list(parser, "--systems", SYSTEMS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen subject."""
    subject = next(subjects.each(options, [options.subject], options.edge_mm))
    points = landmark_points(subjects.chosen_template(options, options.edge_mm))
    tracks = MuscleTracks.of(
        subject.model, template_shapes(subject.model, subjects.shapes(options))
    )
    follow = _Follower(subject, tracks, points, _options(options))
    found: Figures = {"edge_mm": options.edge_mm, "subject": subject.name}
    found["known"] = {
        system: _known(follow, system, quick=options.quick) for system in options.systems
    }
    if options.films is not None:
        files = sorted(each for each in options.films.iterdir() if each.suffix.lower() in FILMS)
        found["films"] = {
            system: {file.name: _film(follow, system, file, options.frames) for file in files}
            for system in options.systems
        }
    return found


def _options(options: argparse.Namespace) -> FilmOptions:
    shading = ShadingOptions() if options.shading else None
    return FilmOptions(expression=ExpressionOptions(shading=shading))


@dataclass(frozen=True)
class _Follower:
    """Fits frames of a subject by a system."""

    subject: Subject
    tracks: MuscleTracks
    points: SkinPoints
    options: FilmOptions

    def face(self, system: str) -> ShapeFace[Any]:
        model = self.subject.model
        if system == "B":
            return PlainFace(model, self.tracks)
        return TrackFace(model, self.tracks, track_potentials(model), linear=fastest())

    def __call__(self, system: str, frames: Sequence[Callable[[], Photo] | None]) -> list[Followed]:
        """Fit frames; one that is None has no face."""
        seen = [each for each in frames if each is not None]
        told = np.linspace(0, len(seen) - 1, self.options.focal_frames).astype(int)
        plain = PlainFace(self.subject.model, self.tracks)
        focal = find_focal(plain, [seen[k]() for k in told], self.points, self.options)
        tracker = FilmTracker(self.face(system), self.points, focal, self.options)
        found = []
        for each in frames:
            if each is None:
                tracker.pause()
                found.append(Followed(0.0, None))
                continue
            photo = each()
            begun = time.perf_counter()
            tracker.step(photo)
            found.append(Followed(time.perf_counter() - begun, tracker.point))
        return found


def _known(follow: _Follower, system: str, *, quick: bool) -> Figures:
    model = follow.subject.model
    random = np.random.default_rng(TAKE.seed)
    moving, still = (TAKE.quick, TAKE.quick) if quick else (TAKE.moving, TAKE.still)
    face = PlainFace(model, follow.tracks)
    points = follow.points
    bias = TAKE.bias_px * random.standard_normal((len(points.names), 2))
    skins = []
    frames = []
    for number in range(moving + still):
        share = min(number / moving, 1.0)
        weights = {
            name: most * float(np.sin(np.pi * times * share) ** 2)
            for name, (most, times) in TAKE.weights.items()
        }
        skin = face.skin(face.move(face.rest(), follow.tracks.controls(weights)))
        places = _camera(model.skin.vertices[model.face], share).project(points.at(skin))[:, :2]
        places = places + bias + TAKE.noise_px * random.standard_normal(places.shape)
        marks = {n: each for n, each in zip(points.names, places, strict=True) if n.isdigit()}
        shown = np.zeros((TAKE.size[1], TAKE.size[0], 3), np.float32)
        skins.append(skin)
        frames.append(lambda marks=marks, shown=shown: Photo("made", shown, landmarks=marks))
    found = follow(system, frames)
    off = [
        _off(each.point.skin, skin, model.face)
        for each, skin in zip(found, skins, strict=True)
        if each.point is not None
    ]
    neutral = [_off(model.skin.vertices, skin, model.face) for skin in skins]
    figures = {
        "neutral_mm": float(np.mean(neutral)),
        "off_mm": float(np.mean(off)),
        "jitter_px": _jitter(found[-still:], points),
        **_seconds(found),
    }
    log.info("known by %s: %s", system, figures)
    return figures


def _camera(face: Floats, share: float) -> PinholeCamera:
    pitch, yaw = np.radians(TAKE.turn_deg) * np.sin(0.5 * np.pi * share)
    turn = small_motion(np.array([pitch, yaw, 0.0, 0.0, 0.0, 0.0])).rotation
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    shift = np.array([10.0, -5.0, TAKE.distance_mm]) - rotation @ face.mean(axis=0)
    return PinholeCamera(np.full(2, TAKE.focal_px), np.array(TAKE.size) / 2.0, rotation, shift)


def _off(skin: Floats, truth: Floats, face: np.ndarray) -> float:
    motion = weighted_motion(skin[face], truth[face], np.ones(len(face)))
    return float(np.linalg.norm(motion(skin[face]) - truth[face], axis=1).mean())


def _jitter(still: Sequence[Followed], points: SkinPoints) -> float:
    """Return how far the skin's points stray about where they are on average, px."""
    settled = [each.point for each in still[SETTLED:] if each.point is not None]
    places = np.array([p.cameras[0].project(points.at(p.skin))[:, :2] for p in settled])
    return float(np.sqrt(np.mean((places - places.mean(axis=0)) ** 2)))


def _seconds(found: Sequence[Followed]) -> Figures:
    fitted = [each.seconds for each in found if each.point is not None]
    return {
        "first_s": fitted[0],
        "frame_s": float(np.median(fitted[1:])),
        "most_s": max(fitted[1:]),
    }


def _film(follow: _Follower, system: str, file: Path, most: int) -> Figures:
    """Return the figures of a film; of one without a face how many frames it has."""
    footage = FilmFile(file)
    numbers = range(min(most, len(footage)))
    try:
        marks = find_marks(footage, numbers, _landmarker).landmarks
    except InputError as error:
        return {"frames": len(numbers), "no_face": len(numbers), "refused": error.code}
    names = follow.points.detected().names
    hidden = set(names[::HELD_OUT])

    def shown(number: int) -> Photo:
        known = {n: p for n, p in marks[number].items() if n not in hidden}
        return replace(footage.photo(number), landmarks=known)

    def frame(number: int) -> Callable[[], Photo] | None:
        return (lambda: shown(number)) if number in marks else None

    found = follow(system, [frame(number) for number in numbers])
    off = []
    for number, each in zip(numbers, found, strict=True):
        if each.point is not None:
            given = marks[number]
            eyes = np.linalg.norm(np.subtract(*(given[str(n)] for n in EYE_CORNERS)))
            left = follow.points.select([n for n in names if n in hidden and n in given])
            places = each.point.cameras[0].project(left.at(each.point.skin))[:, :2]
            away = places - np.array([given[n] for n in left.names])
            off.append(100 * float(np.linalg.norm(away, axis=1).mean() / eyes))
    figures = {
        "frames": len(numbers),
        "no_face": len(numbers) - len(off),
        "held_out_percent": float(np.mean(off)),
        "jitter_px": _still_jitter(follow, system, footage.photo(min(marks))),
        **_seconds(found),
    }
    log.info("%s by %s: %s", file.name, system, figures)
    return figures


def _still_jitter(follow: _Follower, system: str, photo: Photo) -> float:
    """Return the jitter of a frame that is repeated with a sensor's noise."""
    footage = _Repeated(photo, SETTLED + TAKE.still)
    marks = find_marks(footage, range(len(footage)), _landmarker).landmarks

    def frame(number: int) -> Callable[[], Photo]:
        return lambda: replace(footage.photo(number), landmarks=marks[number])

    return _jitter(follow(system, [frame(number) for number in sorted(marks)]), follow.points)


@dataclass(frozen=True)
class _Repeated(Footage):
    """One picture again and again, each time with noise of its own."""

    picture: Photo
    count: int
    name: str = "still"

    def __len__(self) -> int:
        return self.count

    def number(self, name: str) -> int | None:
        del name
        return None

    def photo(self, number: int) -> Photo:
        noise = np.random.default_rng(number).standard_normal(self.picture.pixels.shape)
        spoilt = np.round(255 * np.clip(self.picture.pixels + TAKE.sensor * noise, 0.0, 1.0))
        return replace(self.picture, pixels=(spoilt / 255).astype(np.float32))


def _landmarker(_photo: str) -> Path:
    file = landmarker_file()
    if file is None:
        raise SystemExit("films ask for MediaPipe and its model in MYOFACE_FACE_LANDMARKER")
    return file


COLUMNS = {
    "neutral_mm": "neutral, mm",
    "off_mm": "off, mm",
    "jitter_px": "still jitter, px",
    "first_s": "first frame, s",
    "frame_s": "a frame, s",
}
FILM_COLUMNS = {
    "frames": "frames",
    "no_face": "without a face",
    "held_out_percent": "left out, %",
    "jitter_px": "still jitter, px",
    "frame_s": "a frame, s",
}


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    rows = [
        [system, *(round(float(each[key]), 2) for key in COLUMNS)]
        for system, each in figures["known"].items()
    ]
    parts: list[Table | str] = [Table(["", *COLUMNS.values()], rows)]
    for system, films in figures.get("films", {}).items():
        rows = [
            [name, *(round(float(each[key]), 2) if key in each else "" for key in FILM_COLUMNS)]
            for name, each in films.items()
        ]
        parts.append(Table([system, *FILM_COLUMNS.values()], rows))
    return Section(
        "Films",
        "Distances of the face to the one that was filmed, the head's motion apart, means of the "
        "frames (`known`); distances of landmarks left out, in parts of the distance of the outer "
        "corners of the eyes (`films`); how far the skin strays in pictures of what stands still.",
        parts,
    )


if __name__ == "__main__":
    main()
