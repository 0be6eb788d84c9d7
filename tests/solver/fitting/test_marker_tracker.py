"""Takes of the small person whose muscles, jaw and head are known: clean, degraded, with gaps."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.warp import spread
from solver.errors import SolveError
from solver.fitting import prior
from solver.fitting.calibration import fibre_muscles, with_fibres
from solver.fitting.expression_basis import LINEAR, ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.markers.observation import MarkerOptions, Markers, SeenMarkers
from solver.fitting.markers.places import RefineOptions, frames_near_neutral, refine, triangle_axes
from solver.fitting.markers.prediction import PredictedPlaces, RatedPlaces
from solver.fitting.markers.reach import reach
from solver.fitting.markers.robust import RobustOptions, judge
from solver.fitting.markers.smooth import TracedFrame, smooth
from solver.fitting.markers.term import HeadPrior, MarkerPlaces
from solver.fitting.tracking import Tracker
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.scans.markers.places.bind import model_face, place_on
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import small_motion
from tests.fixtures import small_capture, small_model

RATE = 60.0
MARKERS = 40
NOISE = 0.15


@pytest.fixture(scope="module")
def face():
    return Face(small_model())


@pytest.fixture(scope="module")
def markers(face):
    """Markers spread evenly over the face, 2 mm off the skin."""
    model = face.model
    triangles = model.skin.faces[np.isin(model.skin.faces, model.face).all(axis=1)]
    middles = model.skin.vertices[triangles].mean(axis=1)
    chosen = triangles[spread(middles, MARKERS)]
    corners = [tuple(map(int, each)) for each in chosen]
    return [Marker("", each, (0.3, 0.3, 0.4), 2.0) for each in corners]


@pytest.fixture(scope="module")
def places(face, markers):
    return MarkerPlaces(face.model, markers)


@pytest.fixture(scope="module")
def known(face):
    skin = small_capture("neutral").vertices
    shapes = [small_capture(name).vertices - skin for name in ("smile", "surprise", "ah")]
    return prior.from_basis(face, ExpressionBasis.solve(face, np.stack(shapes), LINEAR))


@pytest.fixture(scope="module")
def take(face, places, known):
    """The first direction of the prior comes and goes while the head turns: skin and points."""
    values, vectors = np.linalg.eigh(known.covariance)
    change = 0.8 * np.sqrt(values[-1]) * vectors[:, -1]
    rng = np.random.default_rng(4)
    state = face.rest
    skins = []
    heads = []
    points = []
    for phase in np.linspace(0.0, 1.5 * np.pi, 24):
        pose = face.rest_pose().add(0.5 * (1.0 - np.cos(phase)) * change)
        state = face.continuation(state, pose)
        skins.append(face.face_points(state.x))
        heads.append(
            small_motion(np.array([0.2 * np.sin(phase), 0.1 * phase, 0.0, 9.0, phase, 0.0]))
        )
        points.append(heads[-1](places.at(state.x)) + NOISE * rng.standard_normal((MARKERS, 3)))
    return np.array(skins), heads, np.array(points)


def tracker_of(face, places, known):
    return Tracker(Markers(face, places, np.full(MARKERS, 0.3), known, 1.0 / RATE))


def off(face, state, skin):
    return float(np.linalg.norm(face.face_points(state.x) - skin, axis=1).mean())


@pytest.mark.long
def test_face_and_head_are_followed(face, places, known, take):
    skins, heads, points = take
    tracker = tracker_of(face, places, known)
    moved = np.linalg.norm(skins - skins[0], axis=2).mean(axis=1).max()
    assert moved > 1.0
    for skin, head, seen in zip(skins, heads, points, strict=True):
        fit = tracker.step(SeenMarkers(seen))
        assert not fit.predicted
        assert (fit.judged.states == "seen").all()
        assert off(face, fit.state, skin) < 0.3
        assert fit.placed.head.then(head.inverse()).degrees < 0.5
        assert face.flesh.count_inverted(fit.state.x) == 0


@pytest.mark.long
def test_wrong_markers_are_found_and_swaps_mended(face, places, known, take):
    skins, _, points = take
    tracker = tracker_of(face, places, known)
    rng = np.random.default_rng(5)
    for number, skin in enumerate(skins[:14]):
        seen = points[number].copy()
        states = np.full(MARKERS, "seen", "<U10")
        if number > 3:
            thrown = rng.choice(MARKERS, 3, replace=False)
            far = rng.standard_normal((3, 3))
            seen[thrown] += 15.0 * far / np.linalg.norm(far, axis=1, keepdims=True)
            states[thrown] = "outlier"
            left = np.flatnonzero(states == "seen")
            one = int(rng.choice(left))
            other = left[np.argsort(np.linalg.norm(seen[left] - seen[one], axis=1))[1]]
            seen[[one, other]] = seen[[other, one]]
            states[[one, other]] = "swapped"
            gone, ghost = rng.choice(np.flatnonzero(states == "seen"), 2, replace=False)
            states[gone] = "missing"
            states[ghost] = "relabelled"
            free = seen[[ghost]].copy()
            seen[[gone, ghost]] = np.nan
        fit = tracker.step(SeenMarkers(seen, free if number > 3 else None))
        np.testing.assert_array_equal(fit.judged.states, states)
        assert off(face, fit.state, skin) < 0.35


@pytest.mark.long
def test_what_nothing_tells_of_fades_and_comes_back(face, places, known, take):
    skins, _, points = take
    tracker = tracker_of(face, places, known)
    for seen in points[:12]:
        before = tracker.step(SeenMarkers(seen))
    none = np.full_like(points[0], np.nan)
    gone = [tracker.step(SeenMarkers(none)) for _ in range(6)]
    assert all(fit.predicted and fit.held.all() for fit in gone)
    assert not before.held.all()
    rest = face.layout.rest
    last = before.state.pose.vector()
    kept = np.exp(-6 / RATE)
    np.testing.assert_allclose(gone[-1].state.pose.vector() - rest, kept * (last - rest), atol=1e-6)
    assert (gone[-1].sd > before.sd).all()
    again = tracker.step(SeenMarkers(points[12]))
    assert off(face, again.state, skins[12]) < 0.35


@pytest.mark.long
def test_a_take_goes_on_from_what_a_frame_left(face, places, known, take):
    points = take[2]
    tracker, other = (tracker_of(face, places, known) for _ in range(2))
    for seen in points[:4]:
        fit = tracker.step(SeenMarkers(seen))
    for each in (tracker, other):
        each.begin(fit.state, tracker.memory)
    fits = [each.step(SeenMarkers(points[4])) for each in (tracker, other)]
    np.testing.assert_allclose(fits[0].state.x, fits[1].state.x, atol=1e-9)
    np.testing.assert_allclose(fits[0].sd, fits[1].sd, rtol=1e-9)


def test_points_are_judged_by_what_the_others_say():
    """Ten points on a bar that may be anywhere: one is off, two are each other's."""
    rng = np.random.default_rng(6)
    points = np.zeros((10, 3))
    points[:, 0] = 10.0 * np.arange(10)
    one = np.tile(np.eye(3), (10, 1))
    prediction = PredictedPlaces(points, 400.0 * one @ one.T + 0.01 * np.eye(30))
    seen = points + 7.0 + 0.1 * rng.standard_normal(points.shape)
    seen[3] += (0.0, 8.0, 0.0)
    seen[[6, 7]] = seen[[7, 6]]
    seen[9] = np.nan
    judged = judge(prediction, seen, np.full((10, 3), 4.0), np.full((1, 3), 200.0))
    expected = ["seen"] * 3 + ["outlier"] + ["seen"] * 2 + ["swapped"] * 2 + ["seen", "missing"]
    assert judged.states.tolist() == expected
    np.testing.assert_allclose(judged.points[[6, 7]], seen[[7, 6]])
    assert judged.weights[3] == judged.weights[9] == 0.0
    assert np.delete(judged.weights, [3, 9]).min() > 0.9


def test_a_lost_marker_that_is_found_counts_in_full():
    """The point of an outlier's label is among the unlabelled."""
    points = np.zeros((6, 3))
    points[:, 0] = 10.0 * np.arange(6)
    one = np.tile(np.eye(3), (6, 1))
    prediction = PredictedPlaces(points, 400.0 * one @ one.T + 4.0 * np.eye(18))
    seen = points + 2.0
    lost = seen[0].copy()
    seen[0] += 10.0
    judged = judge(prediction, seen, np.full((6, 3), 4.0), lost[None])
    assert judged.states.tolist() == ["relabelled"] + ["seen"] * 5
    assert judged.weights.min() > 0.9


def test_places_are_predicted_alike_by_their_covariance_and_by_their_rates():
    """A turned head and four controls of twelve points, of which two are not seen."""
    rng = np.random.default_rng(4)
    places = rng.normal(0.0, 40.0, (12, 3))
    jacobian = rng.normal(0.0, 3.0, (36, 4))
    precision = np.diag([4.0, 9.0, 1.0, 16.0])
    motion = small_motion(np.array([0.2, -0.4, 0.1, 5.0, 6.0, 7.0]))
    head = HeadPrior(motion, np.diag(np.repeat([100.0, 0.04], 3)))
    centre = places.mean(axis=0)
    spread = jacobian @ np.linalg.inv(precision) @ jacobian.T
    by_covariance = PredictedPlaces.of(head, centre, places, spread)
    by_rates = RatedPlaces.of(head, centre, places, jacobian, precision)
    assert by_covariance.sd.min() > 3.0
    np.testing.assert_allclose(by_rates.sd, by_covariance.sd)
    seen = motion(places) + rng.normal(0.0, 2.0, (12, 3))
    weights = np.where(np.arange(12) < 10, 4.0, 0.0)[:, None] * np.ones(3)
    first, second = (each.condition(seen, weights) for each in (by_covariance, by_rates))
    assert np.linalg.norm(first.points - by_covariance.points, axis=1).min() > 0.3
    np.testing.assert_allclose(second.points, first.points, atol=1e-9)
    np.testing.assert_allclose(second.sd, first.sd)
    np.testing.assert_allclose(by_rates.conditional_mean(seen, weights), first.points, atol=1e-9)


@pytest.mark.long
def test_places_that_are_bound_wrong_are_mended(face, markers, places, known, take):
    """Each marker is bound 1.5 mm beside its place; the take says where it is."""
    points = take[2]
    rest = face.model.rest
    true = places.at(rest)
    skin = model_face(face.model)
    rng = np.random.default_rng(8)
    axes = triangle_axes(places.corners(rest))
    turn = rng.uniform(0.0, 2.0 * np.pi, MARKERS)
    aside = 1.5 * np.stack([np.cos(turn), np.sin(turn), np.zeros(MARKERS)], axis=1)
    wrong = [
        replace(place_on(marker, at, skin), sigma_mm=1.0)
        for marker, at in zip(markers, true + np.einsum("kij,kj->ki", axes, aside), strict=True)
    ]
    mended = refine(face, wrong, known, list(points[::2]), 2.0 / RATE)
    before, after = (
        np.linalg.norm(MarkerPlaces(face.model, each).at(rest) - true, axis=1).mean()
        for each in (wrong, mended)
    )
    assert before == pytest.approx(1.5, rel=0.1)
    assert after < 0.7 * before
    # as the file of a set wants them
    assert all(min(marker.weights) >= 0.0 for marker in mended)


def test_places_are_mended_by_the_frames_nearest_the_neutral_face(face, places, take):
    points = take[2].copy()
    points[1, : MARKERS // 2 + 1] = np.nan  # too little is seen
    chosen = frames_near_neutral(
        places.at(face.model.rest),
        points.__getitem__,
        range(len(points)),
        3,
        RefineOptions(apart=1),
    )
    # the face goes from rest and comes back half way
    assert chosen == [0, 2, 4]


def test_frames_are_chosen_in_any_axes_of_a_take(face, places, take):
    turn = small_motion(np.array([0.0, 2.0, 0.0, 40000.0, -9000.0, 3000.0]))
    points = np.array([turn(seen) for seen in take[2]])
    at = places.at(face.model.rest)
    options = RefineOptions(apart=1)
    here, there = (
        frames_near_neutral(at, each.__getitem__, range(len(each)), 3, options)
        for each in (take[2], points)
    )
    assert here == there


@pytest.mark.parametrize(
    "fault", [SolveError("solve.no_convergence", ""), np.linalg.LinAlgError("singular")]
)
def test_a_frame_that_cannot_be_fitted_keeps_the_face(
    fault, face, places, known, take, monkeypatch
):
    _, heads, points = take
    tracker = tracker_of(face, places, known)
    before = tracker.step(SeenMarkers(points[0]))
    seen = points[1].copy()
    seen[2] += 25.0
    seen[5] = np.nan
    with monkeypatch.context() as patch:

        def fail(*_args, **_kwargs):
            raise fault

        patch.setattr(tracker.solver, "fit", fail)
        kept = tracker.step(SeenMarkers(seen))
    assert kept.kept
    assert not kept.predicted
    np.testing.assert_array_equal(kept.state.x, before.state.x)
    # it tells what it saw, and follows the head
    states = np.full(MARKERS, "seen", "<U10")
    states[[2, 5]] = "outlier", "missing"
    np.testing.assert_array_equal(kept.judged.states, states)
    off_points = np.linalg.norm(kept.placed.head(places.at(before.state.x)) - seen, axis=1)
    np.testing.assert_allclose(kept.residual_mm, off_points, atol=1e-9)
    assert kept.placed.head.then(heads[1].inverse()).degrees < 0.5
    # and determines no control
    assert kept.held.all()
    np.testing.assert_allclose(kept.information, 0.0, atol=1e-9)
    assert (kept.sd >= before.sd).all()
    assert not tracker.step(SeenMarkers(points[2])).kept


def test_points_without_a_finite_sigma(face, places, known, take):
    seen = take[2][0].copy()
    sigma = np.full((MARKERS, 3), 0.2)
    seen[3] = np.nan
    sigma[3] = np.inf
    sigma[4] = np.nan
    fit = tracker_of(face, places, known).step(SeenMarkers(seen, None, sigma))
    assert fit.judged.states[[3, 4]].tolist() == ["missing", "seen"]
    assert off(face, fit.state, take[0][0]) < 0.3


def test_markers_that_err_alike_in_every_frame_are_not_believed_more(face, places, known, take):
    """A hundred frames of one still face say no more than the first."""
    tracker = tracker_of(face, places, known)
    fits = [tracker.step(SeenMarkers(take[2][0])) for _ in range(12)]
    assert (
        fits[-1].sd[face.layout["activations"]].mean()
        > 0.9 * fits[0].sd[face.layout["activations"]].mean()
    )


def test_a_head_that_was_lost_is_found_again(face, places, known, take):
    """Two markers in the first frames; then all, with the head turned away."""
    tracker = tracker_of(face, places, known)
    few = np.full_like(take[2][0], np.nan)
    few[:2] = take[2][0][:2]
    for _ in range(3):
        tracker.step(SeenMarkers(few))
    head = small_motion(np.array([0.0, 0.9, 0.0, 80.0, 0.0, 0.0]))
    fit = tracker.step(SeenMarkers(head(places.at(face.rest.x))))
    assert fit.placed.head.then(head.inverse()).degrees < 0.5
    assert (fit.judged.states == "seen").all()


@pytest.mark.long
def test_a_sweep_in_blocks_is_that_in_one(face, places, known, take):
    tracker = tracker_of(face, places, known)
    fits = [tracker.step(SeenMarkers(seen)) for seen in take[2][:7]]
    traced = [TracedFrame(fit.state.pose, fit.placed.head, fit.judged.weights) for fit in fits]
    whole, parts = (smooth(tracker.observation, traced, *each) for each in ((), (3,)))
    for one, other in zip(whole, parts, strict=True):
        np.testing.assert_allclose(one.controls, other.controls, atol=5e-3)
        np.testing.assert_allclose(one.sd, other.sd, rtol=0.05)


@pytest.mark.long
def test_a_sweep_back_bridges_a_gap(face, places, known, take):
    """In a gap the filter fades to rest; the sweep goes to what comes after it."""
    points = take[2]
    tracker = tracker_of(face, places, known)
    fits = []
    gap = range(6, 12)
    for number, seen in enumerate(points[:18]):
        fits.append(
            tracker.step(SeenMarkers(np.full_like(seen, np.nan) if number in gap else seen))
        )
    traced = [TracedFrame(fit.state.pose, fit.placed.head, fit.judged.weights) for fit in fits]
    swept = smooth(tracker.observation, traced)
    values, vectors = np.linalg.eigh(known.covariance)
    way = vectors[:, -1] / np.sqrt(values[-1])
    phases = np.linspace(0.0, 1.5 * np.pi, 24)
    for number in gap:
        true = 0.8 * 0.5 * (1.0 - np.cos(phases[number]))
        before = (fits[number].state.pose.vector() - known.mean) @ way
        after = (swept[number].controls - known.mean) @ way
        if number > 7:
            assert abs(after - true) < 0.6 * abs(before - true)
        assert swept[number].sd.mean() < fits[number].sd.mean()
    np.testing.assert_allclose(swept[-1].controls, fits[-1].state.pose.vector(), atol=1e-9)


def test_markers_reach_fibre_muscles_too(markers):
    plain = Face(small_model(), material=MOONEY_RIVLIN)
    fibred = with_fibres(plain, fibre_muscles(plain))
    known = prior.from_changes(fibred.layout, [], prior.LOOSE)
    few, many = (reach(fibred, each, known) for each in (markers[:5], markers))
    assert many.information.shape == (plain.model.muscle_count,)
    assert (many.information >= few.information - 1e-9).all()
    assert many.information.max() > 0.5
    gains = [each.gain for each in few.further]
    assert gains == sorted(gains, reverse=True)


def test_a_muscle_that_only_goes_along_in_expressions_is_not_determined(face, markers):
    """Of an expression in which the deep ones move with what is seen."""
    loose = reach(face, markers, prior.from_changes(face.layout, [], prior.LOOSE)).information
    hidden = int(loose.argmin())
    seen = int(loose.argmax())
    change = np.zeros(face.layout.size)
    change[face.layout.muscles[[hidden, seen]]] = 0.5
    tied = prior.from_changes(face.layout, [change])
    found = reach(face, markers, tied)
    assert found.by_expressions[hidden] > 0.5 > found.information[hidden]
    assert found.following_muscles >= 1


@pytest.mark.long
def test_held_muscles_keep_still_while_others_move(face, places, take):
    """Of a face whose left markers are gone the muscles there fade to rest, and do no more."""
    points = take[2].copy()
    loose = prior.from_changes(face.layout, [], prior.LOOSE)
    tracker = tracker_of(face, places, loose)
    left = places.at(face.model.rest)[:, 0] > 5.0
    before = [tracker.step(SeenMarkers(seen)) for seen in points[:10]][-1]
    points[:, left] = np.nan
    gone = [tracker.step(SeenMarkers(seen)) for seen in points[10:18]]
    held = gone[-1].held & ~before.held
    assert held.any()
    rest = face.rest_pose().a
    faded = np.exp(-8 / RATE) * (before.state.pose.a - rest)
    assert np.abs(gone[-1].state.pose.a - rest - faded)[held].max() < 0.02


@pytest.mark.long
def test_a_first_frame_far_from_rest_is_judged_by_the_face_that_it_shows(face, places, known):
    values, vectors = np.linalg.eigh(known.covariance)
    state = face.continuation(face.rest, face.rest_pose().add(np.sqrt(values[-1]) * vectors[:, -1]))
    skin = face.face_points(state.x)
    seen = SeenMarkers(places.at(state.x))
    strict = MarkerOptions(robust=RobustOptions(scale_mm=0.3))

    def fit_first(options):
        markers = Markers(face, places, np.full(MARKERS, 0.3), known, 1.0 / RATE, options)
        return Tracker(markers).step(seen)

    once = fit_first(replace(strict, looks=0))
    looked = fit_first(strict)
    assert looked.rejected_count == 0 < once.rejected_count
    assert off(face, looked.state, skin) < 0.75 * off(face, once.state, skin)
