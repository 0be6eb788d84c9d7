"""The marker term: places and derivatives against differences, the head eliminated."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.fitting.face import Face
from solver.fitting.markers.term import HeadPrior, MarkerPlaces, MarkerTerm
from solver.fitting.objective import GramCurvature, SumTerm
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.boundary import move_jaw
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import Similarity, small_motion
from tests.solver.block import head_block, poses


@pytest.fixture(scope="module")
def face():
    block = head_block()
    low = np.flatnonzero((block.rest[:, 1] < 45.0) & (block.rest[:, 2] < 30.0))
    return Face(replace(block, mandible=low))  # two layers of vertices, which span space


def a_set(model):
    """Markers on the skin, off it, on the forehead's bone and on the lower teeth."""
    rng = np.random.default_rng(2)
    shares = rng.dirichlet(np.ones(3), 8)
    faces = model.skin.faces[rng.choice(len(model.skin.faces), 8, replace=False)]
    skin = [
        Marker(f"S{n}", tuple(map(int, corners)), tuple(share), height)
        for n, (corners, share, height) in enumerate(
            zip(faces, shares, rng.uniform(0, 9, 8), strict=True)
        )
    ]
    bones = [
        Marker("HEAD", part="head", place_mm=(60.0, 110.0, 0.0)),
        Marker("TEETH", part="lower_teeth", place_mm=(70.0, 20.0, 30.0)),
    ]
    return [*skin, *bones]


def a_term(face, precision=None, **head):
    """What was seen lies some mm off a turned head's markers; one marker is missing."""
    rng = np.random.default_rng(3)
    places = MarkerPlaces(face.model, a_set(face.model))
    motion = Similarity(1.0, Rotation.from_rotvec([0.2, -0.3, 0.1]).as_matrix(), np.full(3, 20.0))
    seen = motion(places.at(face.model.rest)) + 3.0 * rng.standard_normal((len(places), 3))
    if precision is None:
        precision = rng.uniform(0.5, 4.0, seen.shape)
    precision[4] = 0.0
    seen[4] = np.nan
    return MarkerTerm(places, seen, precision, **head)


def moved(face):
    rng = np.random.default_rng(6)
    return face.model.rest + 0.5 * rng.standard_normal(face.model.rest.shape), rng


def test_places_ride_on_skin_skull_and_mandible(face):
    model = face.model
    places = MarkerPlaces(model, a_set(model))
    b = np.array([0.1, 0.02, 1.0, -2.0, 0.5])
    x = model.rest.copy()
    x[model.mandible] = face.mandible(b)
    before = places.at(model.rest)
    after = places.at(x)
    np.testing.assert_allclose(before[8:], [[60, 110, 0], [70, 20, 30]], atol=1e-9)
    np.testing.assert_allclose(after[8], before[8])
    np.testing.assert_allclose(after[9], move_jaw(model.jaw, before[9:], b)[0], atol=1e-9)
    turn = small_motion(np.array([0.3, 0.2, -0.1, 5.0, 6.0, 7.0]))
    skin = slice(0, 8)  # heights turn with the skin
    np.testing.assert_allclose(places.at(turn(model.rest))[skin], turn(before)[skin], atol=1e-9)


def test_places_derivative_matches_differences(face):
    x, rng = moved(face)
    places = MarkerPlaces(face.model, a_set(face.model))
    step = rng.standard_normal(x.shape)
    change = (places.at(x + 1e-5 * step) - places.at(x - 1e-5 * step)).ravel() / 2e-5
    assert np.abs(change[:24]).min() > 1e-4
    np.testing.assert_allclose(places.jacobian(x) @ step.ravel(), change, atol=1e-7)


@pytest.mark.parametrize("axes", ["alike", "own"])
def test_gradient_matches_differences(face, axes):
    x, rng = moved(face)
    alike = np.full((10, 3), 2.0) if axes == "alike" else None
    head = HeadPrior(small_motion(np.array([0.15, -0.2, 0.1, 18.0, 21.0, 20.0])), 5.0 * np.eye(6))
    term = a_term(face, alike, **({} if axes == "alike" else {"head": head}))
    step = rng.standard_normal(x.shape)
    slope = (term.value(x + 1e-5 * step) - term.value(x - 1e-5 * step)) / 2e-5
    assert abs(slope) > 1.0
    assert np.sum(term.gradient(x) * step) == pytest.approx(slope, rel=1e-6)


def test_curvature_is_that_of_a_head_that_follows(face):
    """Where nothing is left the Gauss-Newton matrix is the Hessian."""
    x, rng = moved(face)
    term = a_term(face)
    exact = term.place(term.places.at(x)).points
    term = MarkerTerm(term.places, np.where(term.precision > 0, exact, np.nan), term.precision)
    step = rng.standard_normal(x.shape)
    change = (term.gradient(x + 1e-5 * step) - term.gradient(x - 1e-5 * step)) / 2e-5
    assert np.abs(change).max() > 1e-2
    found = (term.curvature(x) @ step.ravel()).reshape(x.shape)
    np.testing.assert_allclose(found, change, atol=1e-5 * np.abs(change).max())
    # a motion of the whole head changes nothing
    flesh = Sensitivity(face, face.rest)
    assert isinstance(term.curvature(x), GramCurvature)
    jacobian = flesh.by_pose()
    dense = SumTerm((term, term)).curvature(x)
    np.testing.assert_allclose(
        jacobian.contract(dense), 2.0 * jacobian.contract(term.curvature(x)), rtol=1e-6, atol=1e-6
    )


def test_the_normal_matrix_is_that_of_the_curvature(face):
    (x, rng), term = moved(face), a_term(face)
    at = term.places.at(x)
    placed = term.place(at)
    by_controls = rng.standard_normal((at.size, 9))
    expected = by_controls.T @ term.inner(placed) @ by_controls
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(term.normal(placed, by_controls), expected, rtol=1e-9, atol=1e-9)


def test_the_head_is_found_with_the_face(face):
    [pose] = poses(1)
    state = face.continuation(face.rest, pose)
    term = a_term(face)
    motion = small_motion(np.array([0.4, -0.3, 0.2, 30.0, -20.0, 10.0]))
    seen = np.where(term.precision > 0, motion(term.places.at(state.x)), np.nan)
    term = MarkerTerm(term.places, seen, term.precision)
    placed = term.place(term.places.at(state.x))
    np.testing.assert_allclose(placed.head.twist, motion.twist, atol=1e-3)
    assert term.value(state.x) < 0.05  # what is left is the head's weak prior
    assert term.value(face.rest.x) > 1.0
