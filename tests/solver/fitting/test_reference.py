"""IPOPT's problems: derivatives against differences, and the multi-target problem's minimum."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.fitting import joint, per_tet, reference
from solver.fitting.face import Face, Pose
from solver.fitting.joint import GeometryProblem, Iterate
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.per_tet import PerTetOptions, tissue
from solver.fitting.reference.geometry import FullGeometry
from solver.fitting.simplex import project, replace_values
from tests.solver.block import block_model
from tests.solver.fitting.test_per_tet import contracted, face_with_fibres, target_of

STEP = 1e-6


@pytest.fixture(scope="module")
def face():
    return Face(block_model((3, 3, 2)))


def two_targets(face):
    """Return the skin of two simulated poses: muscles contract along x, the jaw opens."""
    found = {}
    for name, stretch, hinge in (("wide", (0.75, 0.9), 0.1), ("narrow", (0.95, 0.7), 0.03)):
        a = np.array([[s, 0.05, 0.0, 1.0 / np.sqrt(s), 0.0, 1.0 / np.sqrt(s)] for s in stretch])
        pose = Pose(a, np.array([hinge, 0.02, 0.2, -0.5, 0.4]))
        state = face.continuation(face.rest, pose)
        found[name] = SkinDistance(face, Target.from_points(face.face_points(state.x)))
    return found


def smeared(face):
    """Return S with every tet alike: what a fit would have to mend."""
    tets = face.model.weights.shape[0]
    return replace_values(face.model.weights, np.tile([0.6, 0.2, 0.2], tets))


def multi_target(face, data, w_a, w_v, w_s):
    """Return the problem with the rest pose and S as priors, left and right tied to each other."""
    tied = sp.csr_array(0.05 * (sp.eye_array(6, face.S.nnz) - sp.eye_array(6, face.S.nnz, k=9)))
    regulariser = Regulariser(w_a, w_v, 1e-3, face.rest_pose())
    return GeometryProblem(face, data, dict.fromkeys(data, regulariser), w_s, face.S.data, tied)


def differences(function, z, direction):
    return (function(z + STEP * direction) - function(z - STEP * direction)) / (2 * STEP)


def test_derivatives_of_the_multi_target_problem(face):
    S = smeared(face)
    problem = FullGeometry(multi_target(face.with_weights(S), two_targets(face), 0.3, 0.2, 0.1))
    rng = np.random.default_rng(3)
    rest = face.rest
    one = next(iter(problem.parts.values())).start(rest.pose, rest.x)
    z = np.concatenate([one, one, S.data]) + 0.02 * rng.standard_normal(problem.layout.size)
    rows, columns = problem.jacobianstructure()
    shape = (len(problem.constraints(z)), problem.layout.size)
    jacobian = sp.coo_array((problem.jacobian(z), (rows, columns)), shape=shape).tocsr()
    # each kind of variable alone: positions, activations, jaw, and S
    size = face.flesh.size
    each = len(one)
    groups = [(0, size), (size, each - 5), (each - 5, each), (2 * each, problem.layout.size)]
    for first, last in groups:
        direction = np.zeros(problem.layout.size)
        direction[first:last] = rng.standard_normal(last - first)
        numeric = differences(problem.constraints, z, direction)
        assert np.abs(numeric).max() > 1e-3
        np.testing.assert_allclose(jacobian @ direction, numeric, atol=1e-6 * np.abs(numeric).max())
        slope = differences(problem.objective, z, direction)
        assert abs(slope) > 1e-4
        assert problem.gradient(z) @ direction == pytest.approx(slope, rel=1e-5)


def test_the_hessian_is_exact_where_the_residual_vanishes(face):
    """Gauss-Newton leaves out what is multiplied by the residual: there is none on target."""
    S = face.model.weights
    b = np.array([0.05, 0.02, 0.3, -0.2, 0.1])
    x = face.model.rest.copy()
    x[face.model.mandible] = face.mandible(b)
    data = {"on target": SkinDistance(face, Target.from_points(face.face_points(x)))}
    problem = FullGeometry(multi_target(face.with_weights(S), data, 0.3, 0.0, 0.1))
    z = np.concatenate([x[face.flesh.free].ravel(), face.rest_pose().a.ravel(), b, S.data])
    rows, columns = problem.hessianstructure()
    values = problem.hessian(z, np.zeros(0), 1.0)
    lower = sp.coo_array((values, (rows, columns)), shape=(problem.layout.size,) * 2).tocsr()
    hessian = lower + sp.tril(lower, -1).T
    direction = np.random.default_rng(5).standard_normal(problem.layout.size)
    numeric = differences(problem.gradient, z, direction)
    assert np.abs(numeric).max() > 1e-2
    np.testing.assert_allclose(hessian @ direction, numeric, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.long
def test_joint_gauss_newton_reaches_the_multi_target_minimum(face):
    """Both minimise the same, to the same weights: one prior of the activations and of S."""
    S = smeared(face)
    # muscles that are wholly alike stay so until rounding parts them, one way or another
    uneven = S.data + 0.1 * np.random.default_rng(5).standard_normal(S.nnz)
    S = replace_values(S, project(uneven, S.indptr))
    data = two_targets(face)
    problem = multi_target(face.with_weights(S), data, 0.5, 1e-2, 1e-2)
    rest = face.rest
    start = dict.fromkeys(data, rest)
    full = reference.geometry(problem, start)
    assert full.violation < 1e-6
    assert full.S.data.min() >= -1e-8
    np.testing.assert_allclose(full.S.sum(axis=1), 1.0, atol=1e-8)
    assert np.abs(full.S.data - S.data).max() > 0.05

    now = Iterate(S.data, start)
    for _ in range(60):
        now = joint.step(problem, now)
    assert problem.value(S.data, start) > 2.0 * full.objective
    assert problem.value(now.values, now.states) < 1.001 * full.objective


@pytest.mark.long
def test_per_tet_fit_reaches_the_minimum():
    face = face_with_fibres()
    divided = tissue.of_face(face)
    rng = np.random.default_rng(3)
    pose = Pose(contracted(divided, rng, 0.3), np.array([0.1, 0.02, 0.3, -0.4, 0.2]))
    data = SkinDistance(divided.face, target_of(divided, pose))
    options = PerTetOptions(0.03, 1e-3, 1.0, 1e-4, max_iterations=100, tolerance=1e-8)
    full = reference.per_tet(face, data, options)
    assert full.violation < 1e-5
    assert full.objective < 0.1 * data.value(face.model.rest)
    fitted = per_tet.fit(face, data, options=options)
    assert fitted.objective == pytest.approx(full.objective, rel=1e-4)
    np.testing.assert_allclose(fitted.a, full.pose.a, atol=1e-2)


def test_a_solve_that_is_stopped_tells_where_it_was(face):
    data = two_targets(face)["wide"]
    regulariser = Regulariser(0.1, 1e-2, 1e-6, face.rest_pose())
    rest = face.rest
    with pytest.raises(reference.NotConvergedError, match="after 3 iterations") as caught:
        reference.activations(face, data, regulariser, rest.pose, rest.x, max_iterations=3)
    assert caught.value.code == "ipopt.failed"
    last = caught.value.last
    assert np.isfinite(last.x).all()
    assert np.abs(last.pose.a - rest.pose.a).max() > 1e-3
