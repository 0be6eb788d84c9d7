"""Faces that are simulated, as a detector and as FACS see them, beside those they are fitted to.

Seventeen action units, at half and at full intensity, are the template's own shapes; an exact fit
makes them of flesh. Both are drawn, with brows and lips painted, and looked at by MediaPipe:
``cosine`` is of the changes of its 52 weights from the neutral's, ``landmarks_mm`` the mean
distance of its 478 points. ``facs_signs`` counts the units whose own landmarks, points of the skin,
move in flesh as FACS says, and at least three times as far as the median landmark. Needs the extra
``mediapipe`` and MYOFACE_FACE_LANDMARKER; without them only signs are judged.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks import played_person, report
from benchmarks.documents import Figures, Section, Table
from benchmarks.played_person import PlayedPerson
from solver.registration.detector import EYE_CORNERS, DetectedFace, DetectorOptions, FaceDetector
from solver.rig.painted_faces import PaintedFaces
from solver.scans.live_link import ARKIT_NAMES
from solver.scans.openface import UNITS, shapes_of_units
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source

LEVELS = (0.5, 1.0)
QUICK = (12, 26)  # units of a quick run
# Landmarks that FACS names for each unit, the subject's right and left, and where they go: up, down
# or outward; of two that go apart or together the way is that of the first from the second.
SIGNS: dict[int, tuple[tuple[int, ...], str]] = {
    1: ((107, 336), "up"),  # inner ends of the brows
    2: ((70, 300), "up"),  # outer ends
    4: ((107, 336, 66, 296), "down"),
    5: ((159, 386), "up"),  # upper lids
    6: ((117, 346), "up"),  # cheeks under the orbits
    7: ((145, 374), "up"),  # lower lids
    9: ((48, 278), "up"),  # wings of the nose
    10: ((37, 267), "up"),  # upper lip
    12: ((61, 291), "outward"),  # corners of the mouth
    14: ((61, 291), "outward"),
    15: ((61, 291), "down"),
    17: ((18, 200), "up"),  # below the lower lip, chin boss
    20: ((61, 291), "outward"),
    23: ((0, 17), "together"),  # middle of both lips, outside
    25: ((13, 14), "apart"),  # and inside
    26: ((152,), "down"),  # chin
    45: ((159, 386), "down"),
}
APART = 3.0  # times the median landmark's motion

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    played_person.add_options(parser)
    parser.add_argument("--pictures", type=Path, help="folder for the pictures of both")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Return the figures of the chosen person."""
    person = PlayedPerson.of(options)
    units = QUICK if options.quick else UNITS
    levels = LEVELS[-1:] if options.quick else LEVELS
    made: dict[tuple[int, float], tuple[Floats, Floats]] = {}
    for unit in units:
        for level in levels:
            weights = level * weights_of(unit, person.names)
            made[unit, level] = person.shaped(weights), person.exact(weights)
            log.info("AU %d at %g", unit, level)
    figures: Figures = {"units": len(units)}
    figures["signs"] = {str(unit): sign(person, unit, made[unit, 1.0][1]) for unit in units}
    figures["facs_signs"] = sum(each["agrees"] for each in figures["signs"].values())
    file = played_person.detector_file()
    if file is None:
        return {**figures, **played_person.SKIPPED}
    with FaceDetector(file, DetectorOptions(most_faces=1, weights=True)) as detector:
        return {**figures, **_looked_at(person, made, detector, options.pictures)}


def weights_of(unit: int, names: tuple[str, ...]) -> Floats:
    """Return the weights (e,) of a template's shapes that make an action unit at full."""
    row = dict(zip(ARKIT_NAMES, shapes_of_units()[UNITS.index(unit)], strict=True))
    return np.array([row.get(arkit_source(name), 0.0) for name in names])


def sign(person: PlayedPerson, unit: int, skin: Floats) -> Figures:
    """Return how a unit's own landmarks move on its skin (v, 3), and how far the median one."""
    points = person.points
    neutral = person.face.model.skin.vertices
    moved = points.at(skin) - points.at(neutral)
    numbers, way = SIGNS[unit]
    rows = [points.names.index(str(number)) for number in numbers if points.has(str(number))]
    own = moved[rows]
    outward = np.sign(points.at(neutral)[rows, 0])
    if way in ("apart", "together"):
        own = np.vstack([own[:1] - own[1:]]) / 2.0
    along = {"up": own[:, 1], "down": -own[:, 1], "outward": outward[: len(own)] * own[:, 0]}
    along |= {"apart": own[:, 1], "together": -own[:, 1]}
    far = float(np.linalg.norm(own, axis=1).mean())
    median = float(np.median(np.linalg.norm(moved, axis=1)))
    agrees = bool((along[way] > 0.0).all() and far >= APART * median)
    told = {"mm": along[way].mean(), "own_mm": far, "median_mm": median}
    return {**{name: round(float(value), 3) for name, value in told.items()}, "agrees": agrees}


def _looked_at(
    person: PlayedPerson,
    made: dict[tuple[int, float], tuple[Floats, Floats]],
    detector: FaceDetector,
    folder: Path | None,
) -> Figures:
    drawn = PaintedFaces(person.face.model, person.points)
    neutral = person.face.model.skin.vertices
    rest = drawn.look(neutral, detector)
    assert rest is not None, "a face at rest is seen"
    right, left = (person.points.select([str(n)]).at(neutral)[0] for n in EYE_CORNERS)
    mm = float(np.linalg.norm(right - left)) / rest.eyes_px
    cosines = {}
    landmarks = {}
    unseen = []
    for (unit, level), skins in made.items():
        name = f"{unit} at {level:g}"
        pictures = [drawn.picture(skin) for skin in skins]
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            both = (np.hstack(pictures) * 255 + 0.5).astype(np.uint8)
            Image.fromarray(both).save(folder / f"au{unit:02d}-{level:g}.png")
        seen = [next(iter(detector.faces(picture)), None) for picture in pictures]
        if seen[0] is None or seen[1] is None:
            unseen.append(name)
            continue
        cosines[name] = _cosine(seen[0], seen[1], rest)
        apart = np.linalg.norm(seen[0].points - seen[1].points, axis=1)
        landmarks[name] = round(mm * float(apart.mean()), 3)
    worst_of = {
        unit: max(v for n, v in landmarks.items() if n.split()[0] == str(unit))
        for unit in {key[0] for key in made}
        if any(n.split()[0] == str(unit) for n in landmarks)
    }
    return {
        "cosine_min": round(min(cosines.values()), 4),
        "cosine_mean": round(float(np.mean([*cosines.values()])), 4),
        "landmarks_mean_mm": round(float(np.mean([*landmarks.values()])), 3),
        "landmarks_worst_au_mm": max(worst_of.values()),
        "not_seen": unseen,
        "cosine": cosines,
        "landmarks_mm": landmarks,
    }


def _cosine(first: DetectedFace, second: DetectedFace, rest: DetectedFace) -> float:
    """Return the cosine between the changes from rest of both faces' weights."""
    a, b = (
        np.array([face.weights[name] - rest.weights[name] for name in rest.weights])
        for face in (first, second)
    )
    return round(float(a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)), 4)


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    cosines = figures.get("cosine", {})
    landmarks = figures.get("landmarks_mm", {})
    rows = [
        [
            f"AU {unit}",
            *(cosines.get(f"{unit} at {level:g}") for level in LEVELS),
            *(landmarks.get(f"{unit} at {level:g}") for level in LEVELS),
            told["mm"],
            told["median_mm"],
            told["agrees"],
        ]
        for unit, told in figures["signs"].items()
    ]
    heads = ["unit", "cosine at 0.5", "at 1", "landmarks at 0.5, mm", "at 1, mm"]
    heads += ["its own landmarks, mm", "the median one, mm", "as FACS says"]
    return Section(
        title="Action units, seen by a detector",
        compared="The drawn simulation of each unit against its drawn target, by MediaPipe's "
        "weights and landmarks; and its landmarks on the skin against FACS.",
        parts=[Table(heads, rows)],
    )


if __name__ == "__main__":
    main()
