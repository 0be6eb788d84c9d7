"""Viscous flesh: derivatives, and that it stays where it is where flesh comes to rest."""

import numpy as np
import pytest

from solver.fitting.face import Face
from solver.mechanics import equilibrium
from solver.mechanics.flesh import Drag
from solver.mechanics.linear import analyse
from tests.solver.block import block_model

STEP = 1e-6


def test_derivatives():
    plain = Face(block_model()).flesh
    drag = Drag(plain)
    flesh = plain.slowed_by(drag)
    rng = np.random.default_rng(4)
    drag.viscosity = 0.3
    drag.anchor = flesh.rest + 0.1 * rng.standard_normal(flesh.rest.shape)
    a = flesh.passive()
    x = flesh.rest.copy()
    direction = rng.standard_normal(flesh.size)

    def moved(sign):
        y = x.copy()
        y[flesh.free] += sign * STEP * direction.reshape(-1, 3)
        return y

    slope = (flesh.energy(moved(1), a) - flesh.energy(moved(-1), a)) / (2 * STEP)
    assert abs(slope) > 1e-3
    assert flesh.gradient(x, a) @ direction == pytest.approx(slope, rel=1e-6)
    change = (flesh.gradient(moved(1), a) - flesh.gradient(moved(-1), a)) / (2 * STEP)
    np.testing.assert_allclose(
        flesh.hessian(x, a) @ direction, change, atol=1e-6 * np.abs(change).max()
    )


def test_what_held_vertices_do_is_no_drag():
    """Held vertices move by the pose, not by creeping: the drag must not couple to them."""
    plain = Face(block_model()).flesh
    drag = Drag(plain)
    flesh = plain.slowed_by(drag)
    drag.viscosity = 0.3
    drag.anchor = flesh.rest
    rng = np.random.default_rng(4)
    motion = np.zeros((*flesh.rest.shape, 1))
    motion[flesh.held] = rng.standard_normal((len(flesh.held), 3, 1))
    a = flesh.passive()
    x = flesh.rest

    def pulled(sign):
        return flesh.gradient(x + sign * STEP * motion[:, :, 0], a)

    change = (pulled(1) - pulled(-1)) / (2 * STEP)
    assert np.abs(change).max() > 1e-2
    np.testing.assert_allclose(
        flesh.coupling(x, a, motion)[:, 0], change, atol=1e-6 * np.abs(change).max()
    )


def test_it_creeps_to_where_flesh_rests():
    """Step by step it comes to the same equilibrium, which it then does not leave."""
    face = Face(block_model())
    plain = face.flesh
    drag = Drag(plain)
    flesh = plain.slowed_by(drag)
    linear = analyse(plain.hessian(plain.rest, plain.passive()))
    a = plain.passive()
    a[:, 0] = 0.8
    goal = equilibrium.solve_equilibrium(plain, linear, plain.rest, a).x
    drag.viscosity = 0.5
    x = plain.rest
    lengths = []
    for _ in range(25):
        drag.anchor = x
        x = equilibrium.solve_equilibrium(flesh, linear, x, a).x
        lengths.append(np.abs(x - goal).max())
    assert np.abs(plain.rest - goal).max() > 2 * lengths[0] > 0.1
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[-1] < 1e-5
