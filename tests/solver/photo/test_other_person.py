"""Somebody else's photograph is told from the person's own, drawn, with a detector and without."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.photo.camera import PinholeCamera
from solver.photo.identity import PersonShapes
from solver.photo.mesh_points import landmark_points
from solver.photo.other_person import (
    PERSON_OPTIONS,
    DrawnPeople,
    JudgedPicture,
    PersonShift,
    find_other_person,
    not_as_the_rest,
    person_shift,
    somebody_else,
)
from solver.photo.photo import Photo
from solver.registration.detector import FaceDetector
from solver.rig.painted_faces import PaintedFaces, PaintOptions
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template
from tests.fixtures import face_landmarker

TEMPLATE = builtin_template()
POINTS = landmark_points(TEMPLATE)
FACE = TEMPLATE.face_vertices
SIZE = (512, 512)
SMILE = {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "jawOpen": 0.3}


def somebody(seed: int) -> Floats:
    """Return the skin of a random person, whom nothing was learned from."""
    assert TEMPLATE.shapes is not None
    b = np.random.default_rng(seed).standard_normal(len(TEMPLATE.shapes.identity))
    return np.asarray(TEMPLATE.skin.vertices + np.tensordot(b, TEMPLATE.shapes.identity, 1))


def smiling(person: Floats) -> Floats:
    assert TEMPLATE.shapes is not None
    rows = [TEMPLATE.shapes.expression_names.index(name) for name in SMILE]
    weights = np.array([*SMILE.values()])
    return np.asarray(person + np.tensordot(weights, TEMPLATE.shapes.expressions[rows], 1))


def photo(marks: Mapping[str, Floats]) -> Photo:
    return Photo("anna", np.broadcast_to(np.float32(0.0), (*SIZE, 3)), landmarks=marks)


def marked(skin: Floats, distance_mm: float = 650.0) -> Photo:
    """Return the landmarks of a skin from 15 degrees aside, with 2 px of noise."""
    turn = Rotation.from_euler("xy", [5.0, 15.0], degrees=True).as_matrix()
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    shift = np.array([0.0, 0.0, distance_mm]) - rotation @ skin[FACE].mean(axis=0)
    camera = PinholeCamera(np.full(2, 1000.0), np.array(SIZE) / 2.0, rotation, shift)
    places = camera.project(POINTS.at(skin))[:, :2]
    places = places + 2.0 * np.random.default_rng(3).standard_normal(places.shape)
    return photo({n: at for n, at in zip(POINTS.names, places, strict=True) if n.isdigit()})


def codes(neutral: Floats, seen: Photo) -> list[str]:
    found = somebody_else(TEMPLATE, neutral, {seen.name: seen}, POINTS)
    assert found.nats.keys() == {"anna"}
    (nats,) = found.nats.values()
    return [each.code for each in find_other_person("anna", nats, "Anna")]


def test_a_person_s_own_face_is_quiet_and_somebody_else_s_is_told() -> None:
    anna, bert = somebody(1), somebody(4)
    for skin in (anna, smiling(anna)):
        assert codes(anna, marked(skin)) == []
        assert codes(bert, marked(skin)) == ["photo.other_person"]


def test_who_is_not_as_the_rest_is_told() -> None:
    anna, bert = somebody(1), somebody(4)
    given = {"rest": marked(anna), "smile": marked(smiling(anna)), "bert": marked(bert)}
    found = not_as_the_rest(TEMPLATE, given, POINTS)
    told = [n for n, nats in found.nats.items() for _ in find_other_person(n, nats, "the rest")]
    assert told == ["bert"]
    del given["bert"]
    assert max(not_as_the_rest(TEMPLATE, given, POINTS).nats.values()) < 0.0
    del given["rest"]
    alone = not_as_the_rest(TEMPLATE, given, POINTS)
    assert alone.nats == {}
    assert "no other photograph" in alone.figures("smile")["other_person"]


def test_the_shift_is_towards_who_is_seen() -> None:
    assert TEMPLATE.shapes is not None
    people = DrawnPeople.of(TEMPLATE)
    assert people is not None
    random = np.random.default_rng(5)
    # along what landmarks tell most of
    b = 2.0 * np.linalg.pinv(people.modes)[:, :3] @ random.choice([-1.0, 1.0], 3)
    seen = TEMPLATE.skin.vertices + np.tensordot(b, TEMPLATE.shapes.identity, 1)
    shift = person_shift(PersonShapes.of(TEMPLATE), TEMPLATE.skin, marked(seen), POINTS)
    assert shift is not None
    found, truth = people.modes[:3] @ shift.b, people.modes[:3] @ b
    assert np.linalg.norm(found - truth) < 0.5 * np.linalg.norm(truth)


@pytest.mark.parametrize("seeds", [(1, 4), (3, 4), (4, 5)])
def test_pictures_that_a_detector_marks(seeds: tuple[int, int]) -> None:
    anna, bert = (somebody(seed) for seed in seeds)
    assert TEMPLATE.points is not None
    model: Any = SimpleNamespace(skin=TEMPLATE.skin.with_vertices(anna), face=FACE)
    drawn = PaintedFaces(model, TEMPLATE.points, PaintOptions(size=SIZE))
    with FaceDetector(face_landmarker()) as detector:
        seen = drawn.look(smiling(anna), detector)
    assert seen is not None
    marks = {str(row): place for row, place in enumerate(seen.points)}
    assert codes(anna, photo(marks)) == []
    assert codes(bert, photo(marks)) == ["photo.other_person"]


def test_what_shows_too_little_is_not_judged() -> None:
    seen = marked(TEMPLATE.skin.vertices)
    few = {name: seen.landmarks[name] for name in [*seen.landmarks][::3]}
    few |= {name: seen.landmarks[name] for name in ("33", "263")}
    small = marked(TEMPLATE.skin.vertices, distance_mm=2000.0)
    given = {"few": replace(seen, landmarks=few), "small": small}
    found = somebody_else(TEMPLATE, TEMPLATE.skin.vertices, given, POINTS)
    assert found.nats == {}
    assert "not judged: fewer than 250" in found.figures("few")["other_person"]
    assert "less than 60 px apart" in found.figures("small")["other_person"]
    assert TEMPLATE.points is not None
    points = TEMPLATE.points.select([*TEMPLATE.points.names[1:]])
    other = replace(TEMPLATE, points=points)
    assert DrawnPeople.of(other) is None
    found = somebody_else(other, TEMPLATE.skin.vertices, {"seen": seen}, POINTS)
    assert "was not learned" in found.figures("seen")["other_person"]
    assert DrawnPeople.of(replace(TEMPLATE, points=None)) is None


def test_what_was_learned_is_kept(tmp_path: Path) -> None:
    assert TEMPLATE.points is not None
    random = np.random.default_rng(0)
    spread = np.array([1.0, 0.5, 0.2, 0.1])
    who = spread * random.normal(size=(50, 4))
    information = np.diag([9.0, 4.0, 1.0, 0.1])

    def picture(person: int, other: int) -> JudgedPicture:
        error = 0.2 * spread * random.normal(size=4) + 0.3
        by_other = PersonShift(who[person] - who[other] + error, information)
        return JudgedPicture(person, other, PersonShift(error, information), by_other)

    pictures = [picture(person, (person + 1) % 50) for person in range(50) for _ in range(4)]
    learned = DrawnPeople.learn(TEMPLATE.points, np.eye(4), pictures, modes=2)
    assert np.abs(learned.modes) == pytest.approx(np.eye(4)[:2])
    learned.save(tmp_path / "people.npz")
    again = DrawnPeople.load(tmp_path / "people.npz")
    own, other = np.full(4, 0.3), 0.3 + 1.5 * spread
    for known in (learned, again):
        assert known.another(own) < 0.0 < PERSON_OPTIONS.warn_nats < known.another(other)
        nats = known.apart([own, own, other])
        assert max(nats[:2]) < nats[2]
        assert known.apart([own, own]) == [known.apart([own, own])[0]] * 2
    assert again.another(other) == pytest.approx(learned.another(other), rel=1e-4)
