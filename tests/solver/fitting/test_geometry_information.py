"""What scans tell of S: against solved faces whose S was changed and whose pose follows."""

import numpy as np
import pytest

from solver.fitting.controls import jaw_on_tracks
from solver.fitting.face import Face, Pose
from solver.fitting.geometry_information import (
    InformationOptions,
    Linearisation,
    MuscleInformation,
    pose_precision,
    rank,
    step_towards,
)
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.simplex import replace_values
from solver.mechanics.jaw_tracks import JawTracks
from tests.solver.block import block_model, thinner

OPTIONS = InformationOptions()
STEP = 1e-4


def posed(face, left=1.0, right=1.0, seed=3):
    """Return a state with each of the two muscles moved, or at rest where its factor is 0."""
    rng = np.random.default_rng(seed)
    a = face.rest_pose().a + np.array([[left], [right]]) * 0.25 * rng.standard_normal((2, 6))
    return face.continuation(face.rest, Pose(a, np.array([0.1, 0.0, 0.3, 0.0, 0.5])))


@pytest.fixture(scope="module")
def face():
    return Face(block_model(), tolerance=1e-12)


def test_information_is_what_a_change_of_s_costs_when_the_pose_follows(face):
    linearisation = Linearisation(face)
    state = posed(face)
    weights = np.linspace(0.0, 1.0, len(face.model.face))
    found = linearisation.information(state, weights)
    theta = np.random.default_rng(5).standard_normal(8)
    change = STEP * (linearisation.modes.matrix @ theta)
    skins = []
    for sign in (1, -1):
        other = face.with_weights(replace_values(face.S, face.S.data + sign * change))
        skins.append(face.face_points(other.solve_equilibrium(state.pose, state.x).x))
    moved = ((skins[0] - skins[1]) / (2 * STEP)).ravel()
    root = np.sqrt(np.repeat(weights / weights.sum(), 3) * OPTIONS.independent) / OPTIONS.noise_mm
    motions = Sensitivity(face, state).response.motions(Sensitivity(face, state).pose)
    by_pose = np.asarray(face.face_embedding @ motions.reshape(len(motions), -1))
    by_pose = by_pose.reshape(len(moved), -1)
    # the least that a pose, held by its prior, leaves of the motion
    spread = np.full(face.layout.size, OPTIONS.activation_sd)
    spread[face.layout["jaw"]] = OPTIONS.jaw_sd_mm / np.array([100.0, 100.0, 1.0, 1.0, 1.0])
    rows = np.vstack([root[:, None] * by_pose, np.diag(1.0 / spread)])
    goal = np.concatenate([root * moved, np.zeros(len(spread))])
    least = np.linalg.lstsq(rows, goal, rcond=None)[0]
    cost = np.sum((rows @ least - goal) ** 2)
    assert cost > 0.0
    assert np.isclose(theta @ found @ theta, cost, rtol=1e-4)


def test_a_muscle_that_no_scan_moves_is_not_known(face):
    linearisation = Linearisation(face)
    scanned = [linearisation.information(posed(face, right=0.0))]
    posterior = linearisation.posterior(scanned)
    left, right = MuscleInformation.of(posterior, linearisation.modes.places, 1).information
    assert left > 0.2
    assert right == pytest.approx(0.0, abs=1e-9)


def test_the_expression_that_tells_most_of_s_is_proposed(face):
    """The right muscle fills less flesh than is known: its expression brings S nearer."""
    linearisation = Linearisation(face)
    states = {"left": posed(face, right=0.0, seed=8), "right": posed(face, left=0.0, seed=8)}
    other = face.with_weights(thinner(face.S, 2))
    library = {}
    for name, state in states.items():
        points = other.face_points(other.solve_equilibrium(state.pose, state.x).x)
        library[name] = linearisation.misfit(state, points)
    known = linearisation.posterior([library["left"].information], OPTIONS.step_sd)
    first, second = rank(linearisation, known, library)
    assert first.name == "right"
    assert first.before_mm == second.before_mm >= second.after_mm > first.after_mm > 0.0
    step = step_towards(linearisation.posterior([], 1.0), library["right"])
    assert library["right"].at(step) < 0.8 * library["right"].squared
    after = library["right"].after(step)
    there = 0.5 * step
    assert after.squared == pytest.approx(library["right"].at(step))
    assert after.at(there - step) == pytest.approx(library["right"].at(there))


def test_the_prior_of_a_pose_takes_the_units_of_whatever_jaw_a_face_has(face):
    free = np.diag(pose_precision(face))
    spread = np.array([0.05, 0.05, 5.0, 5.0, 5.0])
    assert np.allclose(free[face.layout["jaw"]], spread**-2.0)
    tracks = JawTracks(face.model.jaw, 0.6, 60.0, 2.0, 0.3)
    on_tracks = face.with_joint(jaw_on_tracks(tracks))
    assert np.allclose(np.diag(pose_precision(on_tracks))[-3:], [0.05**-2, 5.0**-2, 5.0**-2])


def test_muscles_that_only_act_together_are_confused():
    model = block_model()
    # both in the same flesh and alike: the scan knows their sum
    S = model.weights.toarray()
    S[:, 1] = S[:, 2] = S[:, 1:].sum(axis=1) / 2
    face = Face(model)
    face = face.with_weights(replace_values(face.S, S[S > -1.0][: face.S.nnz]))
    a = face.rest_pose().a + 0.3 * np.array([1.0, 0.2, 0.0, -0.5, 0.1, -0.4])
    state = face.continuation(face.rest, Pose(a, np.zeros(5)))
    linearisation = Linearisation(face, 1e4 * np.eye(face.layout.size))
    posterior = linearisation.posterior([linearisation.information(state)])
    found = MuscleInformation.of(posterior, linearisation.modes.places, 1)
    [(first, second, correlation)] = found.confused
    assert (first, second) == (0, 1)
    assert correlation < -0.8
