"""An energy of one's own beside the law: it moves the face, in fits and derivatives, too."""

from dataclasses import dataclass

import numpy as np
import pytest

from solver import ActivationOptions, Face, PassiveTerm, Pose, Sensitivity, Target
from solver.fitting import activation
from solver.fitting.objective import Regulariser, SkinDistance
from tests.solver.block import block_model, poses

STEP = 1e-5
STIFFNESS = 40.0


@dataclass(frozen=True)
class Springs(PassiveTerm):
    vertices: np.ndarray
    places: np.ndarray

    def energy(self, x, controls):
        return 0.5 * STIFFNESS * float(((x[self.vertices[:, 0]] - self.places) ** 2).sum())

    def forces(self, x, controls):
        return STIFFNESS * (x[self.vertices[:, 0]] - self.places)[:, None]

    def stiffness_of(self, some):
        return STIFFNESS * np.tile(np.eye(3), (len(self.vertices[some]), 1, 1, 1))


@pytest.fixture(scope="module")
def pulled():
    """A block whose front is pulled forward, and the same without springs."""
    model = block_model()
    front = np.flatnonzero((model.rest[:, 2] == 15.0) & (model.rest[:, 0] == 20.0))
    springs = Springs(front[:, None], model.rest[front] + [0.0, 0.0, 4.0])
    return Face(model, energy=[springs], tolerance=1e-13), Face(model, tolerance=1e-13)


def skin(face, pose, near, weights=None):
    moved = face if weights is None else face.with_weights(weights)
    return moved.face_points(moved.solve_equilibrium(pose, near).x)


def test_it_moves_the_face(pulled):
    face, plain = pulled
    moved = np.abs(face.face_points(face.rest.x) - plain.face_points(plain.rest.x)).max()
    assert moved > 1.0
    assert face.flesh.energy(face.rest.x, face.flesh.passive()) < face.flesh.energy(
        plain.rest.x, plain.flesh.passive()
    )
    assert len(plain.flesh.terms) == len(face.flesh.terms) - 1


@pytest.mark.parametrize("what", ["activations", "jaw", "weights"])
def test_the_skin_by_what_drives_it(pulled, what):
    face, plain = pulled
    pose = poses(1)[0]
    S = face.S
    rng = np.random.default_rng(3)
    state = face.continuation(face.rest, pose)
    derivatives = Sensitivity(face, state)
    M = face.face_embedding
    assert derivatives.response.minimum
    a = np.zeros_like(pose.a)
    b = np.zeros(5)
    by_S = np.zeros(S.nnz)
    change = {"activations": a, "jaw": b, "weights": by_S}[what]
    change[...] = rng.standard_normal(change.shape)
    if what == "weights":
        controls = derivatives.weights
        direction = by_S
    else:
        controls = derivatives.pose
        direction = pose.layout.join([a, b])
    found = M @ derivatives.response.product(controls, direction)
    ends = []
    for sign in (STEP, -STEP):
        weights = S.copy()
        weights.data = S.data + sign * by_S
        ends.append(skin(face, Pose(pose.a + sign * a, pose.b + sign * b), state.x, weights))
    expected = (ends[0] - ends[1]) / (2 * STEP)
    largest = np.abs(expected).max()
    assert largest > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-6 * largest)
    gradient = rng.standard_normal(found.shape)
    adjoint = derivatives.response.adjoint(controls, M.T @ gradient)
    assert adjoint @ direction == pytest.approx((gradient * expected).sum(), rel=1e-5)
    assert abs(adjoint @ direction) > 1e-2
    # the springs have a part in it
    other = plain.continuation(plain.rest, pose)
    without = Sensitivity(plain, other)
    controls = without.weights if what == "weights" else without.pose
    assert np.abs(M @ without.response.product(controls, direction) - found).max() > 0.01 * largest


def test_a_fit_sees_it(pulled):
    face, plain = pulled
    pose = poses(1)[0]
    points = face.face_points(face.continuation(face.rest, pose).x)
    target = Target.from_points(points)
    left = []
    for each in (face, plain):
        prior = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=each.rest_pose())
        options = ActivationOptions(max_iterations=100, tolerance=1e-10)
        data = SkinDistance(each, target)
        found = activation.fit(each, data, prior, each.rest, options).state
        left.append(target.distances(each.face_points(found.x)).max())
        if each is face:
            assert np.abs(found.pose.a - pose.a).max() < 0.02
    assert left[0] < 0.01 < 0.1 < left[1]
