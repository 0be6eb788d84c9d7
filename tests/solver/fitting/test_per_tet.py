"""The per-tet model: derivatives, contraction roots, and what a fit must find again."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from solver.errors import InputError
from solver.fitting import per_tet, stretches
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.least_squares import DampingOptions
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.per_tet import Objective, PerTetOptions, tissue
from solver.fitting.per_tet.descent import Descent, Status, TetDescentOptions
from solver.fitting.per_tet.objective import PreferredContraction, contraction
from solver.fitting.per_tet.saddle import SaddleSolver
from solver.mechanics.flesh import COROTATED_DET, IDENTITY
from tests.solver.block import block_model

STEP = 1e-5
OPTIONS = PerTetOptions(w_act=0.3, w_sparse=0.05, w_volume=0.7, w_b=1e-3)


def face_with_fibres():
    """Both muscles of the block run along x; one tet in seven is flesh only."""
    model = block_model()
    fibres = np.tile([1.0, 0.0, 0.0], (model.weights.nnz, 1))
    weights = model.weights.copy()
    rows = np.repeat(np.arange(len(model.tets)), np.diff(weights.indptr))
    weights.data = np.where(rows % 7 == 0, weights.indices == 0, weights.data).astype(float)
    return Face(
        replace(model, weights=weights, fibres=fibres), material=COROTATED_DET, tolerance=1e-12
    )


@pytest.fixture(scope="module")
def divided():
    return tissue.of_face(face_with_fibres())


def contracted(divided, rng, spread):
    """Activations that contract along x, every tet by its own amount."""
    stretch = rng.uniform(1.0 - spread, 1.0, len(divided.active))
    zero = np.zeros_like(stretch)
    across = 1.0 / np.sqrt(stretch)
    a = np.stack([stretch, zero, zero, across, zero, across], axis=1)
    return a + 0.1 * spread * rng.standard_normal(a.shape)


def settled(divided, pose, x):
    return divided.face.solve_equilibrium(pose, x)


def target_of(divided, pose):
    face = divided.face
    rest = divided.face.rest
    state = face.continuation(rest, pose)
    return Target.from_points(face.face_points(state.x))


@pytest.fixture(scope="module")
def posed(divided):
    """An objective and a state of it far from rest and from the target."""
    rng = np.random.default_rng(3)
    jaw = np.array([0.1, 0.02, 0.3, -0.4, 0.2])
    target = target_of(divided, Pose(contracted(divided, rng, 0.3), jaw))
    data = SkinDistance(divided.face, target)
    objective = Objective(divided, data, OPTIONS, np.full(5, 0.01))
    pose = Pose(contracted(divided, rng, 0.5), 0.4 * jaw)
    rest = divided.face.rest
    return objective, divided.face.continuation(rest, pose)


def test_tissue_shares_every_tets_volume(divided):
    model = divided.face.model
    flesh = divided.face.flesh
    whole = face_with_fibres().flesh
    volume = np.zeros(len(model.tets))
    where = {tuple(tet): i for i, tet in enumerate(model.tets)}
    np.add.at(volume, [where[tuple(tet)] for tet in flesh.tets], flesh.volumes)
    np.testing.assert_allclose(volume, whole.volumes, rtol=1e-12)
    assert 0 < len(divided.active) < len(model.tets) < len(flesh.tets)
    assert divided.volumes.sum() == pytest.approx(1.0)
    # at rest, with passive activations, two tissues are as one
    passive = divided.face.flesh_controls(np.tile(IDENTITY, (len(divided.active), 1)))
    x = model.rest + 0.2 * np.sin(model.rest)
    assert flesh.energy(x, passive) == pytest.approx(whole.energy(x, whole.passive()), rel=1e-12)


def test_reduced_gradient(posed, divided):
    objective, state = posed
    model = objective.quadratic(state, np.zeros(len(divided.active)), 0.0)
    by_a, by_b = state.pose.layout.split(model.gradient)
    rng = np.random.default_rng(5)
    for jaw in (0.0, 1.0):
        a = rng.standard_normal(by_a.shape) * (1.0 - jaw)
        b = rng.standard_normal(5) * jaw * 0.1
        values = [
            objective.value(
                settled(
                    divided,
                    Pose(state.pose.a + sign * STEP * a, state.pose.b + sign * STEP * b),
                    state.x,
                )
            )
            for sign in (1, -1)
        ]
        numeric = (values[0] - values[1]) / (2 * STEP)
        assert abs(numeric) > 1e-3
        assert np.vdot(by_a, a) + by_b @ b == pytest.approx(numeric, rel=1e-5)


@pytest.mark.long
def test_step_solves_the_reduced_system(posed, divided):
    """Conjugate gradients with the saddle point as preconditioner against a dense solve."""
    objective, state = posed
    model = objective.quadratic(state, np.full(len(divided.active), 0.1), 0.1)
    count = 6 * len(divided.active) + 5
    matrix = np.array([model.product(unit) for unit in np.eye(count)])
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    exact = np.linalg.solve(matrix, -model.gradient)
    step = SaddleSolver(divided, iterations=12, tolerance=1e-10).step(model)
    np.testing.assert_allclose(step, exact, atol=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize(("along", "across"), [(1.0, 2.0), (0.6, 2.5), (1.4, 1.6), (-0.3, 0.1)])
def test_contraction_is_the_minimum(along, across):
    def mean(gamma):
        return 1 / gamma**2 - 2 * along / gamma + 2 * gamma - 2 * across * np.sqrt(gamma)

    grid = np.geomspace(0.01, 100.0, 20001)
    best = grid[np.argmin(mean(grid))]
    near = scipy.optimize.minimize_scalar(
        mean, bounds=(0.9 * best, 1.1 * best), method="bounded", options={"xatol": 1e-10}
    )
    assert contraction(along, across) == pytest.approx(near.x, rel=1e-5)


def test_preferred_contraction_is_found_and_costs_nothing(divided):
    term = PreferredContraction(divided)
    gamma = np.array([1.5, 1.5])
    preferred = np.array([1 / 1.5, 0.0, 0.0, np.sqrt(1.5), 0.0, np.sqrt(1.5)])
    a = np.tile(preferred, (len(divided.active), 1))
    np.testing.assert_allclose(term.contractions(a), gamma, rtol=1e-9)
    assert term.value(a, gamma) < 1e-20
    assert term.value(np.tile(IDENTITY, (len(a), 1)), gamma) > 0.1


def test_activations_stay_positive_definite(divided):
    rng = np.random.default_rng(2)
    a = contracted(divided, rng, 0.4)
    step = rng.standard_normal(a.shape)
    step[0] = -5.0 * a[0]
    assert np.linalg.eigvalsh(stretches.matrices(a + step)).min() < 0.0
    assert np.linalg.eigvalsh(stretches.matrices(stretches.move(a, step))).min() > 0.0
    # to first order it is the sum, and the metric is the length of the step that is left
    small = STEP * step
    np.testing.assert_allclose(stretches.move(a, small), a + small, atol=20 * STEP**2 * 25)
    back = np.einsum("ei,eij,ej->e", step, stretches.metric(a), step)
    A = stretches.matrices(a)
    dA = stretches.matrices(step)
    root = np.linalg.solve(A, dA)
    np.testing.assert_allclose(back, np.einsum("eij,eji->e", root, root), rtol=1e-9)


@pytest.mark.long
def test_round_trip_reaches_the_skin(divided):
    """Weak priors: the skin of random activations and an open jaw is found again."""
    rng = np.random.default_rng(8)
    pose = Pose(contracted(divided, rng, 0.4), np.array([0.12, 0.02, 0.2, -0.5, 0.4]))
    target = target_of(divided, pose)
    weak = PerTetOptions(w_act=1e-4, w_sparse=0.0, w_volume=1e-4, w_b=1e-12, tolerance=1e-4)
    values = []
    fit = per_tet.fit(
        face_with_fibres(),
        SkinDistance(divided.face, target),
        options=weak,
        listen=lambda _, value: values.append(value),
    )
    distance = target.distances(divided.face.face_points(fit.state.x))
    assert distance.max() < 0.05
    assert values == sorted(values, reverse=True)
    assert 0 < len(values) <= fit.iterations
    assert divided.face.flesh.count_inverted(fit.state.x) == 0
    # muscles contract: their preferred activation is short along the fibres
    assert (fit.gamma > 1.02).all()


def test_refused_steps_are_no_minimum_where_viscous_flesh_came_further(divided):
    """Steps far too long for one Newton step: ever shorter ones still lead down."""
    rng = np.random.default_rng(8)
    jaw = np.array([0.2, 0.0, 0.0, -2.0, 1.0])
    target = target_of(divided, Pose(contracted(divided, rng, 0.5), jaw))
    weak = PerTetOptions(w_act=1e-4, w_sparse=0.0, w_volume=1e-4, w_b=1e-12)
    objective = Objective(divided, SkinDistance(divided.face, target), weak, np.zeros(5))
    way = TetDescentOptions(
        largest_step=50.0,
        largest_jaw_step=100.0,
        tets=DampingOptions(1e-7, least=1e-7, grow=8.0),
        corrections=1,
        tries=1,
        snaps=0,
    )

    def descend(reachable):
        found = Descent(objective, divided.face.rest, None, 0, way, reachable)
        return found.run(8, 2e-3), found.best[1]

    status, stopped = descend(np.inf)
    assert status == Status.NO_DESCENT
    _, value = descend(0.4 * stopped)
    assert value < 0.5 * stopped
    # no reason to insist this near to it
    assert descend(0.6 * stopped) == (Status.NO_DESCENT, stopped)


@pytest.mark.long
def test_a_fit_goes_on_from_its_end(divided):
    rng = np.random.default_rng(8)
    target = target_of(divided, Pose(contracted(divided, rng, 0.3), np.zeros(5)))
    data = SkinDistance(divided.face, target)
    face = face_with_fibres()
    first = per_tet.fit(face, data)
    again = per_tet.fit(face, data, first.state)
    assert again.iterations <= 2
    assert again.objective <= first.objective * (1 + 1e-9)


def test_bad_input_is_told(divided):
    face = Face(block_model(), material=COROTATED_DET)
    data = SkinDistance(face, Target.from_points(face.face_points(face.model.rest)))
    with pytest.raises(InputError, match="fibres"):
        per_tet.fit(face, data)
    rest = face.rest_pose()
    state = PosedFace(rest, divided.face.rest.equilibrium)
    with pytest.raises(InputError, match="six activations"):
        per_tet.fit(face_with_fibres(), data, state)
