"""Chord steps with an old stiffness: where they lead, and when they have to end."""

import numpy as np
import pytest

from solver.errors import SolveError
from solver.fitting.face import Face
from solver.mechanics import equilibrium, linear, newton
from solver.mechanics.flesh import Flesh
from tests.solver.block import block_model, grid, poses


class Counting:
    """A linear solver that counts what it factorises."""

    def __init__(self, solver):
        self.solver = solver
        self.count = 0

    def factor(self, data):
        self.count += 1
        return self.solver.factor(data)


def test_coasting_ends_where_newton_does():
    face = Face(block_model())
    rest = face.rest
    pose = rest.pose.toward(poses(1)[0], 0.3)
    near = rest.equilibrium.factor
    near.solve(np.zeros(face.flesh.size))
    face.linear = Counting(face.linear)
    x = face.predict(rest, pose)
    coasted = face.solve_equilibrium(pose, x, near)
    assert face.linear.count == 0
    newton = face.solve_equilibrium(pose, x)
    assert face.linear.count > 0
    assert np.abs(newton.x - x).max() > 0.02
    np.testing.assert_allclose(coasted.x, newton.x, atol=1e-4)


def test_what_stops_early_is_no_equilibrium():
    face = Face(block_model())
    with pytest.raises(SolveError, match="after 1 steps") as caught:
        face.solve_equilibrium(poses(1)[0], face.model.rest, max_iterations=1)
    assert caught.value.code == "solve.no_convergence"
    assert caught.value.context["residual"] > newton.NewtonOptions.stalled


@pytest.fixture(scope="module")
def column():
    """A slender column, held at both ends, and the squeeze at which it is straight but unstable."""
    rest, tets = grid((2, 2, 16), (4.0, 4.0, 64.0))
    held = np.flatnonzero((rest[:, 2] == 0.0) | (rest[:, 2] == 64.0))
    flesh = Flesh(rest, tets, held)
    x = rest * [1.0, 1.0, 0.95]
    return flesh, linear.analyse(flesh.hessian(rest, flesh.passive())), x


def test_no_state_is_predicted_that_is_no_minimum(column):
    """Fits that went on from one came to rest far from where they had been led."""
    flesh, solver, x = column
    factor = newton.Factorization(flesh, solver, x, flesh.passive())
    assert factor.projection > 0
    with pytest.raises(SolveError) as caught:
        equilibrium.newton_predict(flesh, solver, x, flesh.passive())
    assert caught.value.code == "solve.far"


def test_a_column_buckles_however_near_the_stiffness_is_said_to_be(column):
    """No chord step follows the straight column, which is an equilibrium and no minimum."""
    flesh, solver, x = column
    a = flesh.passive()
    x = x + 1e-3 * np.sin(np.pi * x[:, 2:] / x[:, 2].max()) * [1.0, 0.0, 0.0]
    old = newton.Factorization(flesh, solver, flesh.rest, a)
    found = equilibrium.solve_equilibrium(flesh, solver, x, a, near=old)
    assert found.minimum
    assert np.abs(found.x - x).max() > 3.0


def test_what_can_not_be_factorised_says_why(column):
    class Hopeless:
        def factor(self, data):
            raise linear.NotPositiveDefiniteError

    flesh, _, x = column
    for squeeze, code in ((1.0, "solve.singular"), (1e-4, "solve.crushed")):
        factorization = newton.Factorization(
            flesh, Hopeless(), x * [1.0, 1.0, squeeze], flesh.passive()
        )
        with pytest.raises(SolveError) as raised:
            factorization.solve(flesh.rest)
        assert raised.value.code == code
