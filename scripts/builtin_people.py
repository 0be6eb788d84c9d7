"""Learn how drawn people differ from their faces: .venv/bin/python scripts/builtin_people.py MODEL.

MODEL is MediaPipe's ``face_landmarker*.task``; MediaPipe is where `scripts/mediapipe` puts it, or
installed. Writes what `solver/photo/other_person.py` judges photographs of the built-in template
by, and prints what comes of people who were left out (half an hour).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from solver.anatomy.template import Template
from solver.photo.identity import PersonShapes
from solver.photo.mesh_points import landmark_points
from solver.photo.other_person import PEOPLE_FILE, DrawnPeople, JudgedPicture, person_shift
from solver.photo.photo import Photo
from solver.registration.detector import FaceDetector
from solver.registration.shape_fit import identity_model
from solver.registration.topology import topology
from solver.rig.painted_faces import PaintedFaces, PaintOptions
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template

PEOPLE = 80
TURNS_DEG = 10.0, 25.0  # most of pitch and yaw
SIZE = (512, 512)  # px of a picture
MIXED = 2  # mixtures of random expressions beside the named ones
FOLDS = 8  # of people who are left out together
EXPRESSIONS: tuple[dict[str, float], ...] = (
    {},
    {"mouthSmile": 0.9, "cheekSquint": 0.6},
    {"jawOpen": 0.8},
    {"mouthPucker": 0.9, "mouthFunnel": 0.3},
    {"jawOpen": 0.5, "browInnerUp": 0.9, "browOuterUp": 0.9, "eyeWide": 0.9},
    {"noseSneer": 0.9, "mouthUpperUp": 0.7, "browDown": 0.8, "eyeSquint": 0.7},
    {"mouthFrown": 0.9, "browDown": 0.9, "mouthShrugLower": 0.5},
    {"mouthLeft": 0.8, "mouthSmileLeft": 0.6},
)


def neutral_of(template: Template, person: int) -> Floats:
    """Return the skin of a random person at rest."""
    assert template.shapes is not None
    random = np.random.default_rng(person)
    who = random.standard_normal(len(template.shapes.identity))
    return np.asarray(template.skin.vertices + np.tensordot(who, template.shapes.identity, 1))


def expressions(random: np.random.Generator, names: list[str]) -> Iterator[dict[str, float]]:
    """Yield expressions by the template's names: those of the list, and mixtures."""
    for each in EXPRESSIONS:
        sides = {f"{name}{side}": w for name, w in each.items() for side in ("Left", "Right")}
        yield {name: w for name, w in (each | sides).items() if name in names}
    shown = [name for name in names if not name.startswith(("eyeLook", "tongue"))]
    for _ in range(MIXED):
        yield {name: random.uniform(0.2, 1.0) for name in random.choice(shown, 6, replace=False)}


def photographs(template: Template, person: int, detector: FaceDetector) -> Iterator[Photo]:
    """Yield pictures of a person in which the detector sees a face."""
    assert template.shapes is not None
    assert template.points is not None
    names = list(template.shapes.expression_names)
    random = np.random.default_rng(10_000 + person)
    neutral = neutral_of(template, person)
    model: Any = SimpleNamespace(
        skin=template.skin.with_vertices(neutral), face=template.face_vertices
    )
    drawn = PaintedFaces(model, template.points, PaintOptions(size=SIZE))
    front = drawn.camera
    for weights in expressions(random, names):
        rows = [names.index(name) for name in weights]
        moved = np.tensordot(np.array([*weights.values()]), template.shapes.expressions[rows], 1)
        pitch, yaw = np.radians(TURNS_DEG) * random.uniform(-1.0, 1.0, 2)
        drawn.camera = replace(front, pitch=float(pitch), yaw=float(yaw))
        face = drawn.look(neutral + moved, detector)
        if face is not None:
            marks = {str(row): place for row, place in enumerate(face.points)}
            pixels = np.broadcast_to(np.float32(0.0), (*SIZE[::-1], 3))
            yield Photo(f"{person}", pixels, landmarks=marks)


def draw(template: Template, detector: FaceDetector) -> Iterator[JudgedPicture]:
    """Yield every picture of all people."""
    points = landmark_points(template)
    shapes = PersonShapes.of(template)
    for person in range(PEOPLE):
        # of those who are left out together, too
        others = [each for each in range(person % FOLDS, PEOPLE, FOLDS) if each != person]
        random = np.random.default_rng(20_000 + person)
        for photo in photographs(template, person, detector):
            other = int(random.choice(others))
            shifts = [
                person_shift(
                    shapes, template.skin.with_vertices(neutral_of(template, who)), photo, points
                )
                for who in (person, other)
            ]
            if shifts[0] is not None and shifts[1] is not None:
                yield JudgedPicture(person, other, shifts[0], shifts[1])


def judge(learned: DrawnPeople, drawn: list[JudgedPicture]) -> dict[str, tuple[Floats, Floats]]:
    """Return the nats of people who were left out: of the same person, and of two."""
    own = [learned.another(each.by_own.b) for each in drawn]
    others = [learned.another(each.by_other.b) for each in drawn]
    found = {"by a face": (np.array(own), np.array(others))}
    random = np.random.default_rng(0)
    for size in (2, 4, 8):
        same = []
        strange = []
        for each in drawn:
            of_other = [one.by_own.b for one in drawn if one.person == each.other]
            rest = [one.by_own.b for one in drawn if one.person == each.person and one is not each]
            for first, known, left in (
                (each.by_own.b, rest, same),
                (each.by_other.b, of_other, strange),
            ):
                if len(known) >= size - 1:
                    rows = random.choice(len(known), size - 1, replace=False)
                    left.append(learned.apart([first, *(known[row] for row in rows)])[0])
        found[f"one of {size}"] = np.array(same), np.array(strange)
    return found


def main() -> None:
    """Learn from all people, and print what comes of those who were left out."""
    sys.path.append(str(Path(__file__).parents[1] / ".mediapipe"))
    template = builtin_template()
    assert template.points is not None
    assert template.shapes is not None
    points = template.points
    prior = identity_model(topology(template), template.shapes).prior
    with FaceDetector(Path(sys.argv[1])) as detector:
        drawn = list(draw(template, detector))
    DrawnPeople.learn(points, prior, drawn).save(PEOPLE_FILE)
    lines = [f"{len(drawn)} pictures of {PEOPLE} people, {PEOPLE_FILE}"]
    parts = []
    for fold in range(FOLDS):
        held = [each.person % FOLDS == fold for each in drawn]
        known = [d for d, is_held in zip(drawn, held, strict=True) if not is_held]
        known = [each for each in known if each.other % FOLDS != fold]
        left_out = [d for d, is_held in zip(drawn, held, strict=True) if is_held]
        parts.append(judge(DrawnPeople.learn(points, prior, known), left_out))
    for name in parts[0]:
        own, others = (np.concatenate([part[name][side] for part in parts]) for side in (0, 1))
        for limit in (1.0, 2.0, 3.0, 4.0, 5.0):
            lines.append(
                f"{name}, above {limit:g} nats: {100 * (own > limit).mean():.1f} % of {len(own)}, "
                f"of others {100 * (others > limit).mean():.0f} % of {len(others)}"
            )
    print("\n".join(lines))  # noqa: T201


if __name__ == "__main__":
    main()
