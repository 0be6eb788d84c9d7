"""Who somebody is, by landmarks of photographs: a drawn person is found, without expressions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.fitting.least_squares import LeastSquaresStep
from solver.photo.camera import PinholeCamera
from solver.photo.expression import place_views
from solver.photo.identity import (
    IdentityOptions,
    PersonShapes,
    _IdentityProblem,
    _Point,
    fit_identity,
)
from solver.photo.mesh_points import landmark_points
from solver.photo.photo import Photo
from solver.similarity import fit_similarity
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template

TEMPLATE = builtin_template()
POINTS = landmark_points(TEMPLATE)
MEAN = TEMPLATE.skin.vertices
FACE = TEMPLATE.face_vertices
SMILE = {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.6}
CALL = {"jawOpen": 0.4, "browInnerUp": 0.5}
SHOWN: tuple[tuple[Mapping[str, float], float], ...] = (({}, -20.0), (SMILE, 0.0), (CALL, 20.0))


def somebody(seed: int) -> Floats:
    """Return the skin of a random person of the template."""
    assert TEMPLATE.shapes is not None
    b = np.random.default_rng(seed).standard_normal(len(TEMPLATE.shapes.identity))
    return np.asarray(MEAN + np.tensordot(b, TEMPLATE.shapes.identity, 1))


def photographs(person: Floats, noise_px: float) -> list[Photo]:
    """Return photographs of a person from three sides with three expressions, landmarks alone."""
    assert TEMPLATE.shapes is not None
    known = dict(zip(TEMPLATE.shapes.expression_names, TEMPLATE.shapes.expressions, strict=True))
    random = np.random.default_rng(7)
    photos = []
    for number, (weights, yaw) in enumerate(SHOWN):
        skin = person + sum(weight * known[name] for name, weight in weights.items())
        turn = Rotation.from_euler("xy", [5.0, yaw], degrees=True).as_matrix()
        rotation = np.diag([1.0, -1.0, -1.0]) @ turn
        shift = np.array([10.0, -5.0, 650.0]) - rotation @ person[FACE].mean(axis=0)
        camera = PinholeCamera(np.full(2, 1400.0), np.array([270.0, 360.0]), rotation, shift)
        places = camera.project(POINTS.at(skin))[:, :2]
        places = places + noise_px * random.standard_normal(places.shape)
        marks = {n: each for n, each in zip(POINTS.names, places, strict=True) if n.isdigit()}
        photos.append(Photo(f"{number}", np.zeros((720, 540, 3), np.float32), landmarks=marks))
    return photos


def off(skin: Floats, truth: Floats) -> float:
    """Return the mean distance in mm of faces, motion and size apart: no picture tells these."""
    motion = fit_similarity(skin[FACE], truth[FACE])
    return float(np.linalg.norm(motion(skin[FACE]) - truth[FACE], axis=1).mean())


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 2])
def test_a_drawn_person_is_found_and_what_they_do_is_taken_out(seed: int) -> None:
    person = somebody(seed)
    found = fit_identity(TEMPLATE, photographs(person, 2.0), POINTS)
    assert off(found.neutral, person) < 1.8
    assert off(found.neutral, person) < 0.55 * off(MEAN, person)
    rest, smile, call = found.weights
    assert sum(rest.values()) < 0.2
    assert min(smile[name] for name in SMILE) > 0.3
    assert call["jawOpen"] > 0.25


def test_the_model_is_the_objective_s() -> None:
    assert TEMPLATE.shapes is not None
    shapes = PersonShapes.of(TEMPLATE)
    options = IdentityOptions()
    views, _ = place_views(photographs(somebody(0), 2.0), POINTS, TEMPLATE.skin, options.views)
    begun = _Point.at_rest(shapes, len(views))
    begun = replace(begun, cameras=tuple(view.camera for view in views))
    problem = _IdentityProblem(shapes, tuple(views), options, moves_face=True)
    count = problem.places[-1][1].stop
    random = np.random.default_rng(1)
    scale = np.full(count, 0.05)
    for _, camera in problem.places:
        scale[camera] = 1e-3 * np.array([1.0, 1.0, 1.0, 100.0, 100.0, 100.0, 1.0])
    inner = np.abs(scale * random.standard_normal(count))  # weights stay off their bounds
    point = problem.move(begun, LeastSquaresStep(inner, 0.0, 0.0))
    assert point is not None
    way = 1e-4 * scale * random.standard_normal(count)
    slope = float(problem.linearise(point).gradient @ way)
    ends = [problem.move(point, LeastSquaresStep(side * way, 0.0, 0.0)) for side in (1.0, -1.0)]
    assert ends[0] is not None
    assert ends[1] is not None
    change = (problem.value(ends[0]) - problem.value(ends[1])) / 2.0
    assert abs(slope) > 1e-4
    assert slope == pytest.approx(change, rel=1e-5)


def test_a_template_of_one_person_finds_nobody() -> None:
    assert TEMPLATE.shapes is not None
    alone = replace(TEMPLATE, shapes=replace(TEMPLATE.shapes, identity=MEAN[None][:0]))
    with pytest.raises(InputError) as error:
        fit_identity(alone, photographs(MEAN, 0.0), POINTS)
    assert error.value.code == "photo.no_identity"
