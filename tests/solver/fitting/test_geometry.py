"""The multi-target problem: its linear model against a dense one, and what the fit finds."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp

from solver.errors import InputError
from solver.fitting import activation, geometry, joint, simplex
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions, usual_options
from solver.fitting.joint import GeometryProblem, Iterate
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.simplex import mirror_structure, replace_values, smooth_structure, transfer
from tests.solver.block import block_model, divided_block, poses


@pytest.fixture(scope="module")
def face():
    return Face(block_model())


def targets_of(face, count):
    rest = face.rest
    return {
        f"pose {k}": Target.from_points(face.face_points(face.continuation(rest, pose).x))
        for k, pose in enumerate(poses(count))
    }


def smeared(model):
    """Return the model with an S whose muscles are everywhere."""
    weights = replace_values(model.weights, np.tile([0.6, 0.2, 0.2], len(model.tets)))
    return replace(model, weights=weights)


def test_step_solves_the_dense_system():
    """Far from bounds, with damping that dwarfs no term, against the normal equations in full."""
    face = Face(smeared(block_model((3, 2, 2))))
    S = face.model.weights
    data = {name: SkinDistance(face, target) for name, target in targets_of(face, 2).items()}
    regulariser = Regulariser(0.5, 0.1, 1e-4, face.rest_pose())
    structure = sp.csr_array(0.1 * sp.random_array((5, S.nnz), density=0.1, rng=0))
    problem = GeometryProblem(
        face,
        data,
        dict.fromkeys(data, regulariser),
        0.05,
        S.data - 0.1 * np.tile([1, 0, -1], len(S.data) // 3),
        structure,
    )
    states = dict.fromkeys(data, face.rest)
    count = face.rest_pose().a.size + 5
    units = np.concatenate([np.ones(count - 5), np.array([1e4, 1e4, 1, 1, 1]) * 1e-3])
    total = S.nnz + len(data) * count
    matrix = np.zeros((total, total))
    gradient = np.zeros(total)
    matrix[: S.nnz, : S.nnz] = 0.1 * np.eye(S.nnz) + structure.T @ structure
    gradient[: S.nnz] = problem.prior_gradient(S.data)
    for number, (name, term) in enumerate(data.items()):
        x = states[name].x
        sensitivity = Sensitivity(face, states[name])
        response = sensitivity.response
        weights = sensitivity.weights
        jacobian = sensitivity.by_pose()
        by_all = np.zeros((x.size, total))
        by_all[jacobian.free, : S.nnz] = np.stack(
            [response.free_motion(weights, column) for column in np.eye(S.nnz)], axis=1
        )
        own = slice(S.nnz + number * count, S.nnz + (number + 1) * count)
        by_all[jacobian.free, own] = jacobian.flesh
        by_all[:, own] += jacobian.held.toarray()
        matrix += by_all.T @ (term.curvature(x) @ by_all)
        gradient += by_all.T @ term.gradient(x).ravel()
        matrix[own, own] += regulariser.gauss_newton(states[name].pose) + 1e-2 * np.diag(units)
        gradient[own] += regulariser.gradient(states[name].pose)
    rows = np.zeros((S.shape[0], total))
    rows[np.repeat(np.arange(S.shape[0]), 3), np.arange(S.nnz)] = 1.0
    tangent = scipy.linalg.null_space(rows)
    expected = -tangent @ np.linalg.solve(tangent.T @ matrix @ tangent, tangent.T @ gradient)
    expected = simplex.project(S.data + expected[: S.nnz], S.indptr) - S.data
    found = joint.step(
        problem, Iterate(S.data, states, damping=0.05, pose_damping=dict.fromkeys(data, 1e-2))
    )
    change = found.values - S.data
    assert np.abs(expected).max() > 1e-2
    assert np.linalg.norm(change - expected) < 0.1 * np.linalg.norm(expected)


@pytest.mark.long
def test_fit_improves_on_the_wrong_weights_and_stays_on_the_simplex(face):
    """Targets come from the true S; the fit starts from one whose muscles are smeared."""
    targets = targets_of(face, 4)
    start = Face(smeared(face.model))
    data = {name: SkinDistance(start, target) for name, target in targets.items()}
    rest = start.rest
    regulariser = Regulariser(1e-3, 1e-3, 1e-6, start.rest_pose())
    alone = {
        name: activation.fit(start, term, regulariser, rest).state for name, term in data.items()
    }
    before = geometry.mean_error(start, targets, alone)
    fitted = geometry.fit(start, data, GeometryOptions(rounds=12, first_iterations=1))
    after = geometry.mean_error(start, targets, fitted.states)
    assert after < 0.5 * before
    assert fitted.S.data.min() >= 0.0
    np.testing.assert_allclose(fitted.S.sum(axis=1), 1.0, atol=1e-12)
    assert all(face.flesh.count_inverted(state.x) == 0 for state in fitted.states.values())
    # what was found is a good start
    again = geometry.fit(start, data, GeometryOptions(rounds=2), start=fitted.S)
    assert geometry.mean_error(start, targets, again.states) < 0.5 * before


def test_a_fit_begins_where_the_template_was_trained(face):
    targets = targets_of(face, 1)
    smeared_face = Face(smeared(face.model))
    trained = face.S.data.astype(np.float32)
    model = replace(smeared_face.model, trained=trained)
    assert usual_options(model).rounds < usual_options(smeared_face.model).rounds
    begun = []
    options = GeometryOptions(rounds=1, first_iterations=1)
    for start in (Face(model), smeared_face):
        data = {name: SkinDistance(start, target) for name, target in targets.items()}
        given = (
            None
            if start.model.trained is not None
            else replace_values(start.S, trained.astype(np.float64))
        )
        fitted = geometry.fit(start, data, options, start=given)
        begun.append(fitted.S.data)
    np.testing.assert_allclose(*begun, atol=1e-9)


def test_symmetric_option_leaves_changes_alike():
    """One side's muscle contracts more than the other's, so that S changes on one side more."""
    face = Face(block_model((4, 3, 2)))
    model = face.model
    structure = mirror_structure(model, 1.0)
    alike = np.zeros(model.weights.nnz)
    alike[0::3] = -0.2
    alike[1::3] = 0.1
    alike[2::3] = 0.1
    assert structure.shape[0] > 0.8 * model.weights.nnz
    assert np.abs(structure @ alike).max() < 1e-12
    assert np.abs(structure @ (alike * np.tile([0.5, 1.0, 0.0], len(model.tets)))).max() > 0.05
    targets = targets_of(face, 1)
    start = Face(smeared(model))
    data = {name: SkinDistance(start, target) for name, target in targets.items()}
    unlike = []
    for weight in (0.0, 1e-1):
        fitted = geometry.fit(
            start, data, GeometryOptions(rounds=4), structure=mirror_structure(model, weight)
        )
        unlike.append(np.linalg.norm(structure @ (fitted.S.data - start.model.weights.data)))
    assert unlike[1] < 0.2 * unlike[0]


def test_smoothness_holds_neighbouring_compartments_together():
    model = divided_block()
    structure = smooth_structure(model, 4.0)
    of_muscle = np.where(model.weights.indices > 2, 2, model.weights.indices > 0)
    assert np.abs(structure @ of_muscle).max() == 0.0  # as every muscle for itself may change
    upper = np.isin(model.weights.indices, [2, 4]).astype(float)
    np.testing.assert_allclose(np.abs(structure @ upper), 2.0)
    assert smooth_structure(block_model(), 4.0).shape[0] == 0
    mirrored = mirror_structure(model, 1.0)
    assert np.abs(mirrored @ upper).max() == 0.0


def test_weights_go_over_between_whole_muscles_and_compartments():
    whole = block_model()
    divided = divided_block()
    onto = transfer(whole.weights, whole, divided)
    np.testing.assert_allclose(onto.data, divided.weights.data, atol=1e-12)
    back = transfer(divided.weights, divided, whole)
    np.testing.assert_allclose(back.data, whole.weights.data, atol=1e-12)


def test_transferred_weights_follow_tets_and_names(face):
    model = face.model
    same = transfer(model.weights, model, model)
    np.testing.assert_allclose(same.data, model.weights.data, atol=1e-12)
    renamed = replace(model, muscle_names=("right", "left"))
    swapped = transfer(model.weights, model, renamed)
    np.testing.assert_allclose(swapped.toarray()[:, [0, 2, 1]], model.weights.toarray(), atol=1e-12)
    finer = block_model((8, 7, 5))
    onto = transfer(model.weights, model, finer).toarray()
    np.testing.assert_allclose(onto.sum(axis=1), 1.0, atol=1e-12)
    assert np.abs(onto - finer.weights.toarray()).mean() < 0.05
    with pytest.raises(InputError, match="no muscle in common"):
        transfer(model.weights, model, replace(model, muscle_names=("a", "b")))
