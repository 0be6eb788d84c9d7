"""The damped descent on Rosenbrock's valley and the damping rules."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from solver.fitting.activation import DescentOptions
from solver.fitting.joint import JointOptions
from solver.fitting.least_squares import (
    Backtracking,
    DampingOptions,
    LeastSquaresStep,
    SecondOrder,
    StopOptions,
    Termination,
    TrustRegion,
    minimise,
)
from solver.fitting.per_tet.descent import Damping
from solver.fitting.tracking.frame_solver import TrackingOptions

START = np.array([-1.2, 1.0])


@dataclass
class Valley:
    """f = (1 - u)^2 + 100 (v - u^2)^2; no step may be longer than ``far``."""

    far: float = np.inf

    def residual(self, q):
        return np.array([1.0 - q[0], 10.0 * (q[1] - q[0] ** 2)])

    def value(self, q):
        return float(self.residual(q) @ self.residual(q))

    def move(self, q, step):
        return None if np.abs(step.change).max() > self.far else q + step.change

    def linearise(self, q):
        jacobian = np.array([[-1.0, 0.0], [-20.0 * q[0], 10.0]])
        return Linearised(2.0 * jacobian.T @ self.residual(q), 2.0 * jacobian.T @ jacobian)


@dataclass
class Linearised:
    gradient: np.ndarray
    hessian: np.ndarray

    def step(self, damping, trust):
        step = np.linalg.solve(self.hessian + damping * np.eye(len(self.gradient)), -self.gradient)
        step /= max(np.abs(step).max() / trust, 1.0)
        bend = step @ self.hessian @ step
        return LeastSquaresStep(step, self.gradient @ step, bend, np.abs(step).max())


@dataclass
class Followed(Linearised):
    """A model that tells how steps of its matrix follow their gradients, and counts them."""

    made: list

    def step(self, damping, trust):
        self.made.append(self.gradient)
        step = super().step(damping, trust)
        return replace(step, following=lambda: lambda change: np.linalg.solve(self.hessian, change))


SEARCHES = [
    lambda: TrustRegion(DescentOptions().damping),
    lambda: Backtracking(DampingOptions(0.0, least=0.0), tries=12),
]


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("far", [np.inf, 0.3])
def test_the_valley_is_descended(search, far):
    heard = []
    stop = StopOptions(200, promised=1e-14, gained=1e-14)
    found = minimise(Valley(far), START, search(), stop, lambda *told: heard.append(told))
    np.testing.assert_allclose(found.point, 1.0, atol=1e-5)
    assert found.value == Valley().value(found.point)
    assert [number for number, _ in heard] == list(range(1, found.steps + 1))
    assert np.all(np.diff([value for _, value in heard]) < 0.0)


def test_the_end_is_told():
    search = SEARCHES[0]()
    found = minimise(Valley(), START, search, StopOptions(2))
    assert (found.termination, found.steps, found.idle) == (Termination.ITERATIONS, 2, False)
    found = minimise(Valley(far=0.0), START, search, StopOptions(9))
    assert (found.termination, found.steps, found.idle) == (Termination.STUCK, 0, True)
    found = minimise(Valley(), np.ones(2), search, StopOptions(9))
    assert (found.termination, found.steps, found.idle) == (Termination.CONVERGED, 0, True)
    wary = Backtracking(DampingOptions(0.0, least=0.0), least_ratio=2.0)
    found = minimise(Valley(), START, wary, StopOptions(9))
    assert (found.termination, found.steps) == (Termination.UNRELIABLE, 1)


@dataclass
class Cliff:
    """f = (q - 3)^2 up to ``edge``, where it leaps by ``rise`` as flesh does that snaps."""

    edge: float
    rise: float = 50.0
    moves: int = 0

    def value(self, q):
        return float((q[0] - 3.0) ** 2) + (self.rise if q[0] > self.edge else 0.0)

    def move(self, q, step):
        self.moves += 1
        return q + step.change

    def linearise(self, q):
        return Linearised(2.0 * (q - 3.0), 2.0 * np.eye(1))


class Bump(Cliff):
    """f that is highest half way, as where lips cross that both steps and rests keep apart."""

    def value(self, q):
        crossing = np.interp(q[0], [0.2, 0.5, 1.0], [0.0, self.rise, 0.1 * self.rise])
        return float((q[0] - 3.0) ** 2 + crossing)


def test_a_bump_half_way_is_no_leap():
    found = minimise(Bump(1.0, rise=60.0), np.zeros(1), SEARCHES[0](), StopOptions(1))
    assert (found.termination, found.steps) == (Termination.ITERATIONS, 1)
    assert found.value < 9.0


def test_no_step_after_step_is_tried_where_all_of_them_leap():
    """Each is as dear as a search for the equilibrium behind a fold."""
    problem = Cliff(edge=0.0)
    stop = StopOptions(20)
    found = minimise(problem, np.zeros(1), SEARCHES[0](), stop)
    assert (found.termination, found.steps, problem.moves) == (Termination.STUCK, 0, 2)


def test_a_refused_reach_is_not_tried_again_at_once():
    """On the way to the edge every other step would be refused."""
    problem = Cliff(edge=0.9, rise=10.0)
    search = SEARCHES[0]()
    start = np.array([0.2])
    search.descend(problem, start, problem.value(start), StopOptions(20))
    assert problem.moves == 2
    assert search.reach == 0.5


# the rules as each fit had them for itself: (start, [(ratio, damping after it from 1e-2)])
RULES = {
    "activations": (DescentOptions().damping, 0.1, 8e-2, 1e-2 / 8.0, 1e-6),
    "S": (JointOptions().damping, 1e-5, 4e-2, 2.5e-3, 1e-7),
    "poses of S": (JointOptions().pose_damping, 1e-2, 4e-2, 2.5e-3, 1e-6),
    "frames": (TrackingOptions().damping, 1e-3, 4e-2, 2.5e-3, 1e-4),
}


@pytest.mark.parametrize("name", RULES)
def test_damping_follows_the_ratio(name):
    rule, start, grown, fallen, least = RULES[name]
    good, bad = (0.7, 0.4) if name == "frames" else (0.75, 0.25)
    assert rule.start == start
    assert rule.adapt(1e-2, bad - 0.01) == rule.increase(1e-2) == grown
    assert rule.adapt(1e-2, good + 0.01) == fallen
    assert rule.adapt(1e-2, bad) == rule.adapt(1e-2, good) == 1e-2
    assert rule.adapt(1.1 * least, 1.0) == least
    assert rule.adapt(0.9, -np.inf) == (1.0 if name == "frames" else grown * 90.0)


def test_damping_of_every_tet_follows_its_step():
    at = np.tile([1.0, 0.0, 0.0, 1.0, 0.0, 1.0], (3, 1))
    step = np.zeros((3, 6))
    step[:, 0] = [0.01, 0.5, 100.0]
    cut, jaw, damping = Damping.start(3).limit(at, step, np.array([0.04, 0, 0, 0, 0]))
    np.testing.assert_allclose(cut[:, 0], [0.01, 0.5, 0.5])
    np.testing.assert_allclose(damping.tets, [0.25, 1.0, 8.0])
    assert jaw[0] == pytest.approx(0.02)
    assert damping.jaw == pytest.approx(2e-2)
    refused = damping.after_refusal()
    np.testing.assert_allclose(refused.tets, 16.0 * damping.tets)
    assert (refused.fall, refused.is_hindered, damping.is_hindered) == (0.5, True, False)


def test_what_gauss_newton_leaves_out_is_learnt_from_gradients():
    """Of a quadratic f that is stiffer than its model; where it is softer nothing is learnt."""
    rng = np.random.default_rng(4)
    known = np.diag(rng.uniform(1.0, 5.0, 6))
    basis = rng.normal(size=(6, 2))
    left_out = 8.0 * basis @ basis.T
    second = SecondOrder(np.zeros((6, 6)))
    for _ in range(12):
        s = rng.normal(size=6)
        image = (known + second.matrix) @ s
        second = second.after(step_of(s, image), (known + left_out) @ s)
        assert np.linalg.eigvalsh(second.matrix).min() >= -1e-9 * np.abs(second.matrix).max()
    np.testing.assert_allclose(second.matrix, left_out, atol=0.05 * np.abs(left_out).max())
    # f has become softer than its model: what was learnt is given up
    image = (known + second.matrix) @ basis[:, 0]
    second = second.after(step_of(basis[:, 0], image), 0.5 * known @ basis[:, 0])
    assert np.abs(second.matrix).max() == 0.0


def step_of(change, image):
    return LeastSquaresStep(change, 0.0, change @ image, image=image)


def test_a_step_of_which_the_last_matrix_promises_too_little_is_not_made():
    """On a parabola the matrix of the first step tells that a second one would gain nothing."""
    hessian = np.array([[3.0, 1.0], [1.0, 2.0]])
    made = []

    class Parabola(Valley):
        def value(self, q):
            return 1.0 + 0.5 * q @ hessian @ q

        def linearise(self, q):
            return Followed(hessian @ q, hessian, made)

    search = Backtracking(DampingOptions(0.0, least=0.0))
    stop = StopOptions(5, promised=1e-3)
    found = minimise(Parabola(), np.array([0.8, -0.4]), search, stop)
    assert (found.termination, found.steps, found.idle) == (Termination.CONVERGED, 1, True)
    assert len(made) == 1
    # from elsewhere it promises enough; another matrix is not judged by it
    minimise(Parabola(), np.array([0.5, 0.5]), search, stop)
    assert len(made) == 2
    search.forget()
    minimise(Parabola(), np.zeros(2), search, stop)
    assert len(made) == 3
