"""Fits against what they should find: simulate, take the skin, fit, compare; and against IPOPT."""

import numpy as np
import pytest

from solver.anatomy.build import build_subject_model
from solver.errors import InputError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions
from solver.fitting.drives.six_numbers import eigenvalue_deficits
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.mechanics.flesh import NEO_HOOKEAN
from tests.solver.ball import EDGE_MM, meshed_ball
from tests.solver.block import block_model, poses

CONVERGED = ActivationOptions(max_iterations=100, tolerance=1e-10)


@pytest.fixture(scope="module")
def face():
    return Face(block_model())


def target_of(face, pose):
    return Target.from_points(face.face_points(face.continuation(face.rest, pose).x))


def test_round_trip_finds_activations_and_jaw(face):
    for pose in poses(3):
        target = target_of(face, pose)
        weak = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=face.rest_pose())
        data = SkinDistance(face, target)
        fitted = activation.fit(face, data, weak, face.rest, CONVERGED)
        error = target.distances(face.face_points(fitted.state.x))
        assert error.max() < 1e-3
        np.testing.assert_allclose(fitted.state.pose.a, pose.a, atol=0.02)
        np.testing.assert_allclose(fitted.state.pose.b, pose.b, atol=0.02)


def test_neo_hookean_flesh_is_fitted_too():
    """Its activation is a shape to come to rest in: smile and jaw are found as with other laws."""
    face = Face(block_model(), material=NEO_HOOKEAN)
    pose = poses(1)[0]
    target = target_of(face, pose)
    moved = target.distances(face.face_points(face.model.rest))
    weak = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=face.rest_pose())
    data = SkinDistance(face, target)
    fitted = activation.fit(face, data, weak, face.rest, CONVERGED)
    assert moved.max() > 1.0
    assert target.distances(face.face_points(fitted.state.x)).max() < 1e-3
    np.testing.assert_allclose(fitted.state.pose.a, pose.a, atol=0.02)
    np.testing.assert_allclose(fitted.state.pose.b, pose.b, atol=0.02)


def test_an_expression_of_a_ball_is_fitted_with_neo_hookean_flesh():
    """The target is moved skin, not what the flesh can do: it comes nearer and stays upright."""
    model = build_subject_model(meshed_ball(), meshed_ball().skin.vertices, edge_mm=EDGE_MM)
    face = Face(model, material=NEO_HOOKEAN)
    points = face.face_points(model.rest)
    away = points - [0.0, 10.0, 58.0]
    raised = (
        points + [0.0, 1.5, 0.0] * np.exp(-((np.linalg.norm(away, axis=1) / 20.0) ** 2))[:, None]
    )
    target = Target.from_points(raised)
    data = SkinDistance(face, target)
    options = Regulariser(w_a=1e-3, w_v=0.0, w_b=1e-4, prior=face.rest_pose())
    fitted = activation.fit(face, data, options, face.rest)
    before, after = (data.value(x) for x in (model.rest, fitted.state.x))
    assert after < 0.7 * before
    assert face.flesh.count_inverted(fitted.state.x) == 0


def test_reduced_solver_agrees_with_ipopt(face):
    pose = poses(1)[0]
    data = SkinDistance(face, target_of(face, pose))
    regulariser = Regulariser(w_a=0.5, w_v=0.1, w_b=1e-4, prior=face.rest_pose())
    rest = face.rest
    reduced = activation.fit(face, data, regulariser, rest, CONVERGED)
    full = reference.activations(face, data, regulariser, rest.pose, rest.x)
    assert reduced.objective == pytest.approx(full.objective, rel=1e-6)
    assert full.objective > 1e-3
    np.testing.assert_allclose(reduced.state.pose.a, full.pose.a, atol=1e-3)
    settled = face.continuation(rest, pose)
    energy = reference.forward(face, pose, rest.x)
    np.testing.assert_allclose(energy.x, settled.x, atol=1e-4)


def test_regulariser_derivatives_match_finite_differences(face):
    rng = np.random.default_rng(8)
    pose = Pose(
        face.rest_pose().a + 0.3 * rng.standard_normal((2, 6)), 0.1 * rng.standard_normal(5)
    )
    pose.a[0] -= [1.2, 0.0, 0.0, 0.0, 0.0, 0.0]
    deficit, _ = eigenvalue_deficits(pose.a)
    assert deficit.max() > 0.1
    regulariser = Regulariser(0.3, 0.7, 0.4, face.rest_pose(), w_e=0.9)
    exact = regulariser.gradient(pose)
    numeric = np.empty_like(exact)
    for entry in range(len(exact)):
        step = np.zeros(len(exact))
        step[entry] = 1e-6
        values = [
            regulariser.value(Pose(pose.a + s * step[:-5].reshape(-1, 6), pose.b + s * step[-5:]))
            for s in (1, -1)
        ]
        numeric[entry] = (values[0] - values[1]) / 2e-6
    assert np.abs(numeric).min() > 1e-3
    np.testing.assert_allclose(exact, numeric, atol=1e-7 * np.abs(numeric).max())


def test_a_face_keeps_its_rest_for_its_own_weights(face):
    other = face.with_weights(face.S)
    assert face.rest is face.rest
    assert other.rest is not face.rest
    np.testing.assert_allclose(other.rest.x, face.model.rest, atol=1e-6)
    assert activation.rest_curvature(face) is activation.rest_curvature(face)


def test_points_that_are_missing_have_no_weight():
    points = np.ones((4, 3))
    points[2] = np.nan
    target = Target.from_points(points)
    assert target.weights[2] == 0.0
    assert np.isnan(target.distances(np.zeros((4, 3)))[2])
    assert np.isfinite(target.value(np.zeros((4, 3))))
    with pytest.raises(InputError, match="positive weight"):
        Target.from_points(np.full((4, 3), np.nan))
    with pytest.raises(InputError, match="point 3 is -1"):
        Target.from_points(np.zeros((4, 3)), np.array([1.0, 0.0, 2.0, -1.0]))
