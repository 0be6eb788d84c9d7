"""The jaw on its tracks: what holds by construction, derivatives, and tracks found in shapes."""

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.controls import jaw_on_tracks
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.mechanics.boundary import FreeJaw, five_numbers
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.jaw_tracks import JawTrackOptions, JawTracks, nearest_jaw, tracks_of_shapes
from solver.model import CondyleTracks
from tests.fixtures import small_model
from tests.solver.block import block_model

STRAIGHT = JawTracks(small_model().jaw, 0.6, 100.0, 20.0, 0.9)
CURVED = replace(STRAIGHT, bend=0.04, retrusion=2.0)
POSES = [np.array(q) for q in ([0.4, 12.0, 12.0], [0.2, 9.0, 1.0], [0.0, 0.0, 8.0])]


def teeth():
    model = small_model()
    return model.skin.vertices[model.regions["lower_teeth"]]


@pytest.mark.parametrize("tracks", [STRAIGHT, CURVED], ids=["straight", "curved"])
@pytest.mark.parametrize("q", [*POSES, np.array([0.1, -1.5, 3.0])])
def test_the_motion_is_rigid_and_its_derivative_that_of_differences(tracks, q):
    points = teeth()
    h = 1e-6
    matrix = tracks.matrix(q)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-13)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    moved = tracks.move(points, q)
    np.testing.assert_allclose(moved, points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-11)
    exact = tracks.jacobian(points, q)
    for k in range(3):
        step = h * np.eye(3)[k]
        numeric = (tracks.move(points, q + step) - tracks.move(points, q - step)) / (2 * h)
        assert np.abs(numeric).max() > 0.3
        np.testing.assert_allclose(exact[:, :, k], numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("q", POSES)
def test_a_motion_gives_back_its_numbers_and_bounds_cut_it(q):
    points = teeth()
    goal = STRAIGHT.move(points, q)
    np.testing.assert_allclose(nearest_jaw(STRAIGHT, points, goal, np.zeros(3)), q, atol=1e-8)
    bounds = STRAIGHT.lower, np.array([0.15, 20.0, 20.0])
    cut = nearest_jaw(STRAIGHT, points, goal, np.zeros(3), bounds=bounds)
    assert cut[0] == pytest.approx(min(q[0], 0.15), abs=1e-9)


@pytest.mark.parametrize("q", POSES)
def test_the_published_equalities_and_bounds_hold(q):
    """w.Mu = 0, w.(Mm + t - m) = 0, u.(Mm + t - m) = 0; the condyles lie s along their tracks."""
    frame = STRAIGHT.frame
    apart = STRAIGHT.apart
    u, up, ahead = frame.axes
    v = np.cos(STRAIGHT.slope) * ahead - np.sin(STRAIGHT.slope) * up
    w = np.cross(v, u)
    m = frame.origin
    matrix = STRAIGHT.matrix(q)
    M = matrix[:3, :3]
    t = matrix[:3, 3]
    away = M @ m + t - m
    np.testing.assert_allclose([w @ M @ u, w @ away, u @ away], 0.0, atol=1e-12)
    for s, side in ((q[1], 0.5), (q[2], -0.5)):
        assert v @ (M @ (m + side * apart * u) + t - m) == pytest.approx(s, abs=1e-12)
    assert STRAIGHT.lower.tolist() == [0.0, 0.0, 0.0]
    assert STRAIGHT.upper.tolist() == [0.9, 20.0, 20.0]


def test_condyles_on_curved_tracks_stay_apart_and_go_down_the_steeper():
    frame = CURVED.frame
    q = np.array([0.3, 15.0, 4.0])
    matrix = CURVED.matrix(q)
    half = 0.5 * CURVED.apart * frame.axes[0]
    left, right = (matrix[:3, :3] @ (frame.origin + s * half) + matrix[:3, 3] for s in (1, -1))
    assert np.linalg.norm(left - right) == pytest.approx(CURVED.apart)
    ways = [CURVED.move(frame.origin[None], [0.0, s, s])[0] - frame.origin for s in (1.0, 15.0)]
    slopes = [np.arctan2(-way @ frame.axes[1], way @ frame.axes[2]) for way in ways]
    np.testing.assert_allclose(slopes, 0.6 + 0.5 * 0.04 * np.array([1.0, 15.0]), atol=1e-3)
    # as the curve goes the way of the straight track where it is slight
    nearly = replace(CURVED, bend=1e-9).move(teeth(), q)
    np.testing.assert_allclose(nearly, STRAIGHT.move(teeth(), q), atol=1e-5)


def missed(frame, q):
    """Return how far a free jaw (n,) is from one on its tracks, at the lower teeth."""
    points = teeth()
    b = five_numbers(frame, STRAIGHT.matrix(q))
    return np.linalg.norm(FreeJaw(frame).move(points, b) - STRAIGHT.move(points, q), axis=1)


@pytest.mark.parametrize("q", [*POSES, np.array([0.3, 8.0, 0.0])])
def test_five_numbers_say_every_motion_along_straight_tracks(q):
    frame = replace(STRAIGHT.frame, tracks=CondyleTracks(0.6, 100.0, 20.0, 0.9))
    assert missed(frame, q).max() < 1e-10
    assert JawTracks.of(frame) == replace(STRAIGHT, frame=frame)


def test_five_numbers_of_old_models_say_even_slides_and_miss_a_one_sided_one():
    """As the note has it: a condyle 8 mm ahead leaves about a millimetre at the lower teeth."""
    assert missed(STRAIGHT.frame, POSES[0]).max() < 1e-10
    one_sided = missed(STRAIGHT.frame, np.array([0.3, 8.0, 0.0]))
    assert 0.3 < np.sqrt((one_sided**2).mean()) < 3.0


@pytest.mark.parametrize("tracks", [None, CondyleTracks(0.6, 100.0, 20.0, 0.9)])
def test_five_numbers_of_a_free_jaw_are_its_own(tracks):
    free = FreeJaw(replace(STRAIGHT.frame, tracks=tracks))
    points = teeth()
    b = np.array([0.3, 0.1, 2.0, -3.0, 4.0])
    np.testing.assert_allclose(five_numbers(free.frame, free.matrix(b)), b, atol=1e-12)
    np.testing.assert_allclose(
        np.c_[points, np.ones(len(points))] @ free.matrix(b)[:3].T, free.move(points, b), atol=1e-11
    )
    exact = free.jacobian(points, b)
    h = 1e-6
    for k in range(5):
        step = h * np.eye(5)[k]
        numeric = (free.move(points, b + step) - free.move(points, b - step)) / (2 * h)
        assert np.abs(numeric).max() > 0.3
        np.testing.assert_allclose(exact[:, :, k], numeric, atol=1e-6)


def test_tracks_are_found_in_a_templates_shapes():
    points = teeth()
    far = replace(STRAIGHT, slope=np.radians(50.0))
    smile = 0.2 * np.random.default_rng(1).standard_normal(points.shape)
    shapes = [far.move(points, q) - points for q in ([0.44, 16.3, 16.3], [0.0, 6.0, 6.0])]
    found = tracks_of_shapes(STRAIGHT.frame, 100.0, points, [*shapes, smile])
    assert found.slope == pytest.approx(np.radians(50.0), abs=1e-9)
    assert found.bend == 0.0
    assert (found.length, found.retrusion) == (20.0, 0.0)
    bent = [CURVED.move(points, q) - points for q in ([0.44, 16.0, 16.0], [0.0, 5.0, 5.0])]
    curved = tracks_of_shapes(STRAIGHT.frame, 100.0, points, bent, JawTrackOptions(curved=True))
    assert curved.slope == pytest.approx(0.6, abs=0.03)
    assert curved.bend == pytest.approx(0.04, abs=0.004)
    unknown = tracks_of_shapes(STRAIGHT.frame, 100.0, points, [smile], JawTrackOptions())
    assert unknown.slope == pytest.approx(np.radians(35.0))


def test_a_jaw_on_its_tracks_is_fitted_within_them():
    model = block_model()
    tracks = JawTracks(model.jaw, 0.6, 60.0, 2.0, 0.3)
    plain = Face(model)
    face = plain.with_joint(jaw_on_tracks(tracks))
    rest = np.tile(IDENTITY, (model.muscle_count, 1))
    truth = face.continuation(face.rest, Pose(rest, np.array([0.1, 1.5, 0.5]), face.layout))
    prior = Regulariser(w_a=1e-4, w_v=1e-4, w_b=1e-10, prior=face.rest_pose())
    stop = ActivationOptions(40, tolerance=1e-9)

    def fit(state):
        data = SkinDistance(face, Target.from_points(face.face_points(state.x)))
        return activation.fit(face, data, prior, options=stop).state

    np.testing.assert_allclose(fit(truth).pose.b, [0.1, 1.5, 0.5], atol=0.02)
    # further than a condyle goes, and closed beyond the teeth
    beyond = plain.continuation(plain.rest, Pose(rest, np.array([-0.05, 0.0, 0.0, -2.0, 4.0])))
    found = fit(beyond).pose.b
    assert found[0] == 0.0
    assert found[1:].tolist() == [2.0, 2.0]


@pytest.mark.parametrize("tracks", [STRAIGHT, CURVED], ids=["straight", "curved"])
def test_a_departure_is_how_far_the_worse_condyle_is_from_its_track(tracks):
    u, up, ahead = tracks.frame.axes
    v = np.cos(tracks.slope) * ahead - np.sin(tracks.slope) * up
    for q in POSES:
        assert tracks.departure(tracks.matrix(q)) == pytest.approx(0.0, abs=1e-9)

    def departure(shift):
        motion = np.eye(4)
        motion[:3, 3] = shift
        return tracks.departure(motion)

    assert departure(2.0 * u + 0.5 * np.cross(u, v)) == pytest.approx(np.hypot(2.0, 0.5), rel=0.02)
    behind = -(3.0 + tracks.retrusion) * v
    assert departure(behind) == pytest.approx(3.0, rel=0.02)
    far = np.array([0.0, tracks.length + 2.0, tracks.length + 2.0])
    assert tracks.departure(tracks.matrix(far)) == pytest.approx(2.0, rel=0.02)


def test_a_motion_does_not_depend_on_the_one_before():
    points = np.array([[3.0, -60.0, 80.0]])
    for q in (np.array([0.2, 3.0, 1.0]), np.array([0.1, 0.0, 5.0]), np.array([0.2, 3.0, 1.0])):
        np.testing.assert_array_equal(STRAIGHT.move(points, q), replace(STRAIGHT).move(points, q))
    longer = replace(STRAIGHT, slope=0.3)
    assert not np.allclose(longer.move(points, q), STRAIGHT.move(points, q))
