"""Priors over controls: derivatives, expressions, and what time does to them."""

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting import prior
from solver.fitting.controls import jaw_on_tracks
from solver.fitting.expression_basis import LINEAR, ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.objective import PartPrior, PriorSum, Regulariser
from solver.mechanics.jaw_tracks import JawTracks
from tests.fixtures import small_capture, small_model
from tests.solver.block import head_block, poses


@pytest.fixture(scope="module")
def face():
    return Face(head_block())


def test_derivatives_match_differences(face):
    here, there = poses(2)
    known = prior.from_changes(face.layout, [there.vector() - face.layout.rest])
    places = np.arange(1, face.layout.size, 3)
    precision = np.diag(np.linspace(0.5, 2.0, len(places))) + 0.1
    hold = PartPrior(face.layout.size, places, there.vector()[places], precision)
    both = PriorSum((known, Regulariser(0.0, 0.5, 0.0, face.rest_pose()), hold))
    change = np.random.default_rng(1).standard_normal(face.layout.size)
    ends = [here.add(sign * 1e-5 * change) for sign in (-1.0, 1.0)]
    slope = (both.value(ends[1]) - both.value(ends[0])) / 2e-5
    assert abs(slope) > 1.0
    assert both.gradient(here) @ change == pytest.approx(slope, rel=1e-6)
    bent = (known.gradient(ends[1]) - known.gradient(ends[0])) / 2e-5
    np.testing.assert_allclose(known.gauss_newton(here) @ change, bent, rtol=1e-5)


def test_what_an_expression_does_is_probable(face):
    """A shape that the flesh makes gives back the change of the controls that makes it."""
    model = face.model
    pose = face.rest_pose().toward(poses(1)[0], 0.2)
    state = face.continuation(face.rest, pose)
    shape = face.whole_skin(state.x, pose.b) - model.skin.vertices
    known = prior.from_basis(face, ExpressionBasis.solve(face, shape[None], LINEAR))
    change = pose.vector() - known.mean
    other = np.random.default_rng(2).standard_normal(len(change))
    other *= np.linalg.norm(change) / np.linalg.norm(other)
    likely, unlikely = (known.value(face.rest_pose().add(each)) for each in (change, other))
    assert likely < 0.1 * unlikely


@pytest.mark.long
def test_large_shapes_are_fitted():
    """Half of a large shape comes of half its change, where the linear response errs by far."""
    face = Face(small_model())
    rest = small_capture("neutral").vertices
    shape = small_capture("ah").vertices - rest
    options = prior.PriorOptions(strength=1.0)

    def left(known):
        values, vectors = np.linalg.eigh(known.covariance)
        change = np.sqrt(values[-1]) * vectors[:, -1]
        goal = 0.5 * shape[face.model.face]
        off = []
        for sign in (1.0, -1.0):
            state = face.continuation(face.rest, face.rest_pose().add(0.5 * sign * change))
            moved = face.face_points(state.x) - face.face_points(face.rest.x)
            off.append(np.linalg.norm(moved - goal, axis=1).mean())
        return min(off)

    linear = left(prior.from_basis(face, ExpressionBasis.solve(face, shape[None], LINEAR), options))
    heard = []
    fitted = left(
        prior.from_basis(
            face, ExpressionBasis.solve(face, shape[None], listen=heard.append), options
        )
    )
    assert heard == [1.0]
    assert fitted < 0.5 * linear


def test_the_teeth_of_a_shape_move_a_jaw_on_tracks():
    """Of a shape whose skin goes half as far as its teeth the jaw goes with the teeth."""
    plain = Face(small_model())
    tracks = JawTracks(plain.model.jaw, 0.6, 60.0, 2.0, 0.3)
    face = plain.with_joint(jaw_on_tracks(tracks))
    model = face.model
    opening = 0.1
    open_ = replace(face.rest_pose(), b=np.array([opening, 0.0, 0.0]))
    moved = face.whole_skin(face.continuation(face.rest, open_).x, open_.b) - model.skin.vertices
    shape = 0.5 * moved
    shape[model.lower_teeth] = moved[model.lower_teeth]
    options = prior.PriorOptions(strength=1.0)
    known = prior.from_basis(face, ExpressionBasis.solve(face, shape[None], LINEAR), options)
    angle = face.layout.places("tracks")[0]
    assert np.sqrt(known.variance[angle]) == pytest.approx(opening, rel=0.2)


def test_a_muscle_may_do_by_itself_what_it_does_in_an_expression(face):
    rest = face.rest_pose()
    change = 5.0 * (poses(1)[0].vector() - rest.vector())
    known = prior.from_expressions(face, [rest.add(change)])
    alone = np.zeros_like(change)
    first = face.layout.places("activations")[0]
    alone[first] = change[first]
    other = np.zeros_like(change)
    # as much of the same muscle, another way
    other[first] = np.roll(change[first], 1) * [1, -1, 1, -1, 1, -1]
    other *= np.linalg.norm(alone) / np.linalg.norm(other)
    likely, unlikely = (known.value(rest.add(each)) for each in (alone, other))
    assert likely < 0.3 * unlikely


def test_with_nothing_seen_a_pose_goes_back_to_rest(face):
    known = prior.from_changes(face.layout, [])
    mean = known.mean + 1.0
    certain = 0.01 * known.covariance
    short, long = (known.after(mean, certain, time, 1.0) for time in (0.01, 5.0))
    np.testing.assert_allclose(short.mean, known.mean + np.exp(-0.01))
    assert np.all(short.variance < 0.05 * known.variance)
    np.testing.assert_allclose(long.mean, known.mean, atol=0.01)
    np.testing.assert_allclose(long.covariance, known.covariance, rtol=1e-3, atol=1e-9)
