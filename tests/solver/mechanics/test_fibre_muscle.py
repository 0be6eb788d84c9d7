"""Fibre muscles: curves, derivatives against finite differences, and a bar of closed form."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from solver.errors import InputError
from solver.mechanics import equilibrium, linear
from solver.mechanics.fibre_muscle import (
    CURVE,
    FibreMuscles,
    FibreTerm,
    active_force,
    driven_by_muscles,
    passive_force,
)
from solver.mechanics.flesh import MOONEY_RIVLIN, Flesh
from tests.solver.block import block_model, grid
from tests.solver.simulation.test_fibres import fibred_block

STEP = 1e-6


def published(L):
    """Return fp and fa as Blemker, Pinsky and Delp have them, without the joints."""
    grown = 0.05 * (np.exp(6.6 * (min(L, 1.4) - 1.0)) - 1.0)
    passive = grown + 0.33 * np.exp(2.64) * max(L - 1.4, 0.0)
    active = [9.0 * (L - 0.4) ** 2, 1.0 - 4.0 * (1.0 - L) ** 2, 9.0 * (L - 1.6) ** 2]
    return passive if L > 1.0 else 0.0, active[np.searchsorted([0.6, 1.4], L)]


@pytest.mark.parametrize("curve", [passive_force, active_force])
def test_energy_force_and_slope_are_one_anothers_derivatives(curve):
    for L in np.linspace(0.31, 1.79, 149):
        ahead, behind, found = (curve(L + each, CURVE) for each in (STEP, -STEP, 0.0))
        assert found.force == pytest.approx((ahead.energy - behind.energy) / (2 * STEP), abs=1e-8)
        # no kink anywhere
        assert found.slope == pytest.approx((ahead.force - behind.force) / (2 * STEP), abs=1e-4)
        assert found.force >= 0.0


def test_the_curves_are_those_of_the_literature_but_at_their_kinks():
    for L in (0.45, 0.52, 0.7, 0.9, 1.0, 1.1, 1.3, 1.5, 1.58):
        found = passive_force(L, CURVE).force, active_force(L, CURVE).force
        np.testing.assert_allclose(found, published(L), atol=1e-12)
    assert active_force(1.0, CURVE).force == 1.0
    assert active_force(0.39, CURVE).force == active_force(1.61, CURVE).force == 0.0
    for L in (0.6, 1.4):
        assert active_force(L, CURVE).force == pytest.approx(0.36, abs=0.01)


@pytest.fixture(scope="module")
def strained():
    """Two muscles across the block, some fibres short, some long, at activations within bounds."""
    model = fibred_block()
    rng = np.random.default_rng(3)
    muscles = FibreMuscles.of(model, model.weights, np.array([25.0, 40.0]))
    fibres = muscles.fibres + 0.5 * rng.standard_normal(muscles.fibres.shape)
    muscles = replace(muscles, fibres=fibres / np.linalg.norm(fibres, axis=1, keepdims=True))
    flesh = Flesh(model.rest, model.tets, model.cranium)
    x = model.rest.copy()
    x[flesh.free] += 1.2 * rng.standard_normal((len(flesh.free), 3))
    term = FibreTerm(flesh, muscles)
    a = np.array([0.8, 0.3])
    stretches = term.stretches(x)
    assert stretches.min() < 0.7
    assert stretches.max() > 1.3
    assert len(term.tets) < len(muscles.tets)
    return flesh, muscles, x, a, rng


def forces(flesh, muscles, x, a):
    term = FibreTerm(flesh, muscles)
    out = np.zeros_like(x)
    np.add.at(out, term.vertices, term.forces(x, a))
    return out.ravel()


def agree(exact, ends, least=1.0):
    numeric = (ends[0] - ends[1]) / (2 * STEP)
    assert np.abs(numeric).max() > least
    np.testing.assert_allclose(exact, numeric, atol=2e-6 * np.abs(numeric).max())


def test_derivatives_by_x_match_finite_differences(strained):
    flesh, muscles, x, a, rng = strained
    whole = driven_by_muscles(flesh, muscles)
    direction = rng.standard_normal(flesh.size)
    places = [whole.add_motion(x, sign * STEP * direction) for sign in (1, -1)]
    term = FibreTerm(flesh, muscles)
    slope = [np.array(term.energy(each, a)) for each in places]
    by_x = forces(flesh, muscles, x, a)[flesh.free_coordinates]
    agree(by_x @ direction, slope)
    ends = [whole.gradient(each, a) for each in places]
    agree(whole.hessian(x, a) @ direction, ends)
    # the fibres' part is not lost in the flesh's
    relaxed = driven_by_muscles(flesh, muscles.scale(0.0)).hessian(x, a) @ direction
    assert np.abs(whole.hessian(x, a) @ direction - relaxed).max() > 1.0


def test_the_projected_hessian_is_positive_semidefinite_and_passive_muscles_resist(strained):
    flesh, muscles, x, a, _ = strained
    term = FibreTerm(flesh, muscles)
    u, v = np.triu_indices(4)

    def lowest(project):
        blocks = term.blocks(x, a, project=project)
        whole = np.zeros((len(blocks), 4, 3, 4, 3))
        whole[:, u, :, v] = blocks.transpose(1, 0, 2, 3)
        whole[:, v, :, u] = blocks.transpose(1, 0, 3, 2)
        return np.linalg.eigvalsh(whole.reshape(-1, 12, 12)).min()

    assert lowest(0.0) < -1.0
    assert lowest(1.0) > -1e-9
    some = np.array([3, 1])
    np.testing.assert_array_equal(term.blocks(x, a, some=some), term.blocks(x, a)[some])
    assert term.energy(x, np.zeros(2)) > 10.0
    assert np.abs(forces(flesh, muscles, flesh.rest, np.zeros(2))).max() < 1e-20


def test_derivatives_by_activation_strength_fraction_and_direction(strained):
    flesh, muscles, x, a, rng = strained
    term = FibreTerm(flesh, muscles)

    def at(change):
        return [forces(flesh, change(sign * STEP), x, a) for sign in (1, -1)]

    for k in (0, 1):
        unit = np.eye(2)[k]
        ends = [forces(flesh, muscles, x, a + sign * STEP * unit) for sign in (1, -1)]
        agree(term.forces_by_control(x, a)[:, [k]].toarray().ravel(), ends)
        ends = [
            forces(flesh, replace(muscles, strengths=muscles.strengths + step * unit), x, a)
            for step in (STEP, -STEP)
        ]
        agree(term.forces_by_strength(x, a)[:, [k]].toarray().ravel(), ends, 0.1)
    direction = rng.standard_normal(len(muscles.fractions))
    ends = at(lambda step: replace(muscles, fractions=muscles.fractions + step * direction))
    agree(term.forces_by_fraction(x, a) @ direction, ends)
    turns = rng.standard_normal((len(term.tets), 3))
    rates = np.cross(turns[np.searchsorted(term.tets, muscles.tets)], muscles.fibres)
    ends = at(lambda step: replace(muscles, fibres=muscles.fibres + step * rates))
    agree(term.forces_by_rotation(x, a) @ turns.ravel(), ends)


@pytest.mark.parametrize("stretch", [0.7, 0.85, 1.0, 1.2, 1.5])
def test_a_bar_with_one_fibre_pulls_as_its_closed_form(stretch):
    """Fibres along a bar add s sigma (fp + a fa) to its nominal stress, and leave its width."""
    c = 0.25
    bulk = 20.0 / 3.0
    strength = 3.0
    fraction = 0.7
    a = np.array([0.6])

    def pull(width):
        J = stretch * width**2
        long, wide = (each * J ** (-1.0 / 3.0) for each in (stretch, width))
        return 2.0 / J * (long**2 - wide**2) * (c + c * wide**2), bulk * (J - 1.0)

    width = brentq(lambda w: pull(w)[0] - 3.0 * pull(w)[1], 0.5, 1.5, xtol=1e-15)
    vertices, tets = grid((6, 2, 2), (30.0, 10.0, 10.0))
    ends = [vertices[:, 0] == 0.0, vertices[:, 0] == 30.0]
    flesh = Flesh(vertices, tets, np.flatnonzero(ends[0] | ends[1]), MOONEY_RIVLIN)
    count = len(tets)
    along = np.tile([1.0, 0.0, 0.0], (count, 1))
    parts = np.arange(count), np.zeros(count, int), np.full(count, fraction)
    muscles = FibreMuscles(*parts, along, np.array([strength]), np.zeros(1, int))
    whole = driven_by_muscles(flesh, muscles)
    x = vertices * [stretch, width, width]
    start = whole.add_motion(x, 0.2 * np.random.default_rng(4).standard_normal(flesh.size))
    solver = linear.analyse(whole.hessian(vertices, a))
    found = equilibrium.solve_equilibrium(whole, solver, start, a, tolerance=1e-13).x
    np.testing.assert_allclose(found, x, atol=1e-8)
    free = Flesh(vertices, tets, np.zeros(0, int), MOONEY_RIVLIN)
    gradient = driven_by_muscles(free, muscles).gradient(found, a).reshape(-1, 3)
    passive, active = published(stretch)
    fibre = fraction * strength * (passive + a[0] * active) * 100.0
    assert fibre > 10.0
    expected = [pull(width)[0] * (10.0 * width) ** 2 + fibre, 0.0, 0.0]
    np.testing.assert_allclose(gradient[ends[1]].sum(axis=0), expected, atol=1e-6 * fibre)


def test_a_model_without_fibres_has_no_fibre_muscles():
    model = block_model()
    with pytest.raises(InputError) as caught:
        FibreMuscles.of(replace(model, fibres=None), model.weights, np.ones(2))
    assert caught.value.code == "model.fibres"
