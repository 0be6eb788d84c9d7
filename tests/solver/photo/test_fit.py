"""Weights and cameras, found again from pictures of landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.anatomy.skin_points import SkinPoints
from solver.errors import InputError
from solver.fitting.least_squares import LeastSquaresStep
from solver.photo.camera import CAMERA_FREEDOM, POSE_FREEDOM, PinholeCamera
from solver.photo.fit import (
    FocalPrior,
    PhotoFitOptions,
    PhotoPoint,
    PhotoProblem,
    PhotoView,
    fit_photos,
)
from solver.photo.pose import place_camera
from solver.photo.terms import CurveTerm, LandmarkTerm, PseudoHuber
from solver.similarity import small_motion
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace
from solver.tracks.fit import TrackFitOptions
from solver.tracks.plain import PlainFace
from tests.solver.photo.derivatives import check_derivatives
from tests.solver.tracks.block import block_shapes, tracked_block

CHEAP = PhotoFitOptions(controls=TrackFitOptions(w_w=1e-3, w_j=1.0), w_l=0.0)
NOISE_PX = 0.5


def camera_from(yaw: float, points: np.ndarray) -> PinholeCamera:
    """Return a camera 400 mm from the middle of points (n, 3), at a yaw in degrees."""
    turn = Rotation.from_euler("y", yaw, degrees=True).as_matrix()
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    shift = np.array([3.0, -2.0, 400.0]) - rotation @ points.mean(axis=0)
    return PinholeCamera(np.full(2, 900.0), np.array([300.0, 200.0]), rotation, shift)


@pytest.fixture(scope="module")
def model():
    return tracked_block()


@pytest.fixture(scope="module")
def points(model):
    """Sixty points of the block's front."""
    random = np.random.default_rng(0)
    corners = random.choice(model.skin.faces, 60)
    weights = random.dirichlet(np.ones(3), 60)
    return SkinPoints(corners, weights, tuple(map(str, range(60))), np.zeros(60))


def view_of(points: SkinPoints, middle: np.ndarray, skin: np.ndarray, yaw: float) -> PhotoView:
    """Return a picture of a skin, from in front of the middle of points (n, 3)."""
    camera = camera_from(yaw, middle)
    noise = np.full(len(points.names), NOISE_PX)
    random = np.random.default_rng(int(yaw) + 90)
    pixels = camera.project(points.at(skin))[:, :2] + random.normal(0, 0.1, (len(noise), 2))
    # of flat points two cameras look the same: it begins near the right one
    begun = camera.moved(np.array([0.05, -0.05, 0.05, 5.0, 5.0, 20.0, 0.05]))
    return PhotoView((LandmarkTerm(points, pixels, noise),), begun, focal=FocalPrior(900.0, 0.1))


@pytest.mark.parametrize("kind", [TrackFace, PlainFace])
def test_weights_are_found_again_with_the_head_and_the_focal_length(model, points, kind):
    tracks = MuscleTracks.of(model, block_shapes(model))
    face = TrackFace(model, tracks, stiffness_pa=1.0) if kind is TrackFace else kind(model, tracks)
    neutral = model.skin.vertices
    truth = face.move(face.rest(), tracks.controls({"aside": 0.7, "bulge": 0.5}))
    skin = face.skin(truth)
    views = [view_of(points, neutral, skin, yaw) for yaw in (20.0, -30.0)]
    found = fit_photos(face, views, options=CHEAP)
    assert found.point.state.q[:3] == pytest.approx(truth.q[:3], abs=0.1)


def test_a_corrective_comes_with_what_it_corrects_alone(model, points):
    names = {"aside": "mouthClose", "open": "jawOpen", "bulge": "bulge"}
    shapes = {names[name]: motion for name, motion in block_shapes(model).items()}
    face = PlainFace(model, MuscleTracks.of(model, shapes))
    for weights in ({"mouthClose": 0.6}, {"mouthClose": 0.5, "jawOpen": 0.7}):
        truth = face.move(face.rest(), face.tracks.controls(weights))
        view = view_of(points, model.skin.vertices, face.skin(truth), 20.0)
        q = fit_photos(face, [view], options=CHEAP).point.state.q
        found = dict(zip(face.tracks.names, q, strict=False))
        assert found["mouthClose"] <= found["jawOpen"] + 1e-9
    assert found["jawOpen"] == pytest.approx(0.7, abs=0.1)
    assert found["mouthClose"] == pytest.approx(0.5, abs=0.1)


def test_a_linear_price_leaves_out_what_a_picture_hardly_tells(model, points):
    face = PlainFace(model, MuscleTracks.of(model, block_shapes(model)))
    truth = face.move(face.rest(), face.tracks.controls({"aside": 0.7, "bulge": 0.2}))
    view = view_of(points, model.skin.vertices, face.skin(truth), 45.0)
    dear = replace(CHEAP, w_l=12.0)
    free, sparse = (fit_photos(face, [view], options=each).point.state.q for each in (CHEAP, dear))
    others = [number for number, name in enumerate(face.tracks.names) if name != "aside"]
    assert free[others].max() > 0.0
    assert sparse[others].max() == 0.0
    assert sparse[face.tracks.names.index("aside")] == pytest.approx(0.7, abs=0.15)


def test_landmarks_that_a_hand_hides_do_not_pull(model, points):
    face = PlainFace(model, MuscleTracks.of(model, block_shapes(model)))
    truth = face.move(face.rest(), face.tracks.controls({"aside": 0.7, "bulge": 0.5}))
    clean = view_of(points, model.skin.vertices, face.skin(truth), 20.0)
    term = clean.terms[0]
    assert isinstance(term, LandmarkTerm)
    pixels = term.pixels.copy()
    pixels[::12] += 40.0
    spoilt = replace(clean, terms=(replace(term, pixels=pixels),))
    squares = replace(CHEAP, loss=PseudoHuber(1e6))
    robust, least = (
        fit_photos(face, [spoilt], options=options).point.skin for options in (CHEAP, squares)
    )
    away = [np.linalg.norm(skin - face.skin(truth), axis=1).mean() for skin in (robust, least)]
    assert away[0] < 0.2 * away[1]


def test_the_gradient_is_that_of_the_objective(model, points):
    names = {"aside": "mouthClose", "open": "jawOpen", "bulge": "bulge"}
    shapes = {names[name]: motion for name, motion in block_shapes(model).items()}
    face = PlainFace(model, MuscleTracks.of(model, shapes))
    truth = face.move(face.rest(), face.tracks.controls({"mouthClose": 0.7, "jawOpen": 0.8}))
    view = view_of(points, model.skin.vertices, face.skin(truth), 20.0)
    head = small_motion(np.array([0.1, -0.2, 0.05, 8.0, -5.0, 3.0]))
    placed = replace(view, camera=camera_from(-10.0, model.skin.vertices), is_placed=True)
    problem = PhotoProblem(face, (view, placed), PhotoFitOptions(), moves_face=True)
    begun = {"mouthClose": 0.2, "bulge": 0.3, "jawOpen": 0.4}
    state = face.move(face.rest(), face.tracks.controls(begun))
    cameras = view.camera, placed.camera.with_head(head)
    point = PhotoPoint(state, face.skin(state), head, cameras)
    gradient = problem.linearise(point).gradient
    size = face.tracks.size
    step = 1e-5
    assert len(gradient) == size + POSE_FREEDOM + CAMERA_FREEDOM
    for number in range(len(gradient)):
        change = step * np.eye(len(gradient))[number]
        ahead, behind = (
            problem.move(point, LeastSquaresStep(sign * change, 0.0, 0.0)) for sign in (1.0, -1.0)
        )
        expected = (problem.value(ahead) - problem.value(behind)) / (2 * step)
        assert gradient[number] == pytest.approx(expected, rel=1e-4, abs=1e-3)
    assert np.abs(gradient).min() > 1e-2


def test_a_camera_is_placed_by_a_neutral_face_that_is_not_quite_the_one_seen():
    random = np.random.default_rng(3)
    points = random.normal(0.0, 40.0, (30, 3))
    camera = camera_from(30.0, points)
    camera = replace(camera, translation=camera.translation + np.array([0.0, 0.0, 300.0]))
    pixels = camera.project(points + random.normal(0.0, 2.0, points.shape))[:, :2]
    pixels[4] += 200.0
    found = place_camera(points, pixels, np.full(30, 2.0), camera.focal, camera.centre)
    turn = Rotation.from_matrix(found.rotation @ camera.rotation.T).magnitude()
    assert turn < np.radians(6.0)
    assert np.linalg.norm(found.project(points)[:, :2] - camera.project(points)[:, :2]) < 60.0


def test_a_camera_is_placed_alike_in_a_picture_of_any_size():
    random = np.random.default_rng(3)
    points = random.normal(0.0, [60.0, 80.0, 20.0], (40, 3))
    seen_by = camera_from(20.0, points)
    pixels = seen_by.project(points)[:, :2]
    pixels[:6] += 100.0  # wrong ones
    placed = []
    for size in (0.1, 1.0):
        picture = seen_by.scaled(size)
        noise = np.full(40, 2.0)
        placed.append(place_camera(points, size * pixels, noise, picture.focal, picture.centre))
    np.testing.assert_allclose(placed[0].rotation, placed[1].rotation, atol=1e-9)
    np.testing.assert_allclose(placed[0].translation, placed[1].translation, atol=1e-6)


def test_a_line_of_landmarks_places_no_camera():
    line = np.outer(np.arange(10.0), [3.0, 2.0])
    spread = np.random.default_rng(0).normal(0.0, 40.0, (10, 3))
    with pytest.raises(InputError) as error:
        place_camera(spread, line, np.ones(10), np.full(2, 900.0), np.zeros(2))
    assert error.value.code == "photo.pose"


def test_a_curve_s_distances_have_their_derivatives(model, points):
    random = np.random.default_rng(5)
    skin = model.skin.vertices
    camera = camera_from(15.0, skin)
    # a ring, as a lip's border is: lines over one another have no one nearest place
    seen = camera.project(points.at(skin))[:, :2] - camera.project(skin)[:, :2].mean(axis=0)
    around = np.argsort(np.arctan2(*seen.T))[::5]
    line = points.select([points.names[number] for number in around])
    places = camera.project(line.at(skin))[:, :2].mean(axis=0) + random.normal(0, 60, (30, 2))
    term = CurveTerm(line, places, 2.0)
    check_derivatives(term, skin, camera, step=1e-6, tolerance=1e-4)
