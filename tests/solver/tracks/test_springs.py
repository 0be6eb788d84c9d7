"""Springs to targets that are controls: their derivatives, and what holds how firmly."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.terms import check_term
from solver.tracks.springs import TrackedFlesh, spring_stiffness
from tests.solver.tracks.block import tracked_block


@pytest.fixture(scope="module")
def tracked():
    model = tracked_block()
    flesh = Face(model).flesh
    return TrackedFlesh.of(flesh, model.weights, np.array([1.0, 2.0]), 2.0)


@pytest.fixture(scope="module")
def moved(tracked):
    """Return a place of the flesh, its controls, and a direction of the free vertices."""
    flesh = tracked.flesh
    random = np.random.default_rng(5)
    x = flesh.rest + 0.2 * random.standard_normal(flesh.rest.shape)
    a = IDENTITY + 0.1 * random.standard_normal((2, 6))
    target = flesh.rest + random.standard_normal(flesh.rest.shape)
    return x, tracked.controls(a, target), random.standard_normal(flesh.size)


def test_springs_pull_to_their_controls(tracked, moved):
    x, controls, _ = moved
    springs = tracked.springs
    vertices = springs.vertices[:, 0]
    at_target = x.copy()
    at_target[vertices] = springs.places(controls)
    assert springs.energy(at_target, controls) == 0.0
    expected = 0.5 * springs.stiffness @ ((x - at_target)[vertices] ** 2).sum(axis=1)
    assert np.isclose(springs.energy(x, controls), expected)
    assert expected > 1.0


def test_forces_and_stiffness_are_the_energy_s_derivatives(tracked, moved):
    x, controls, _ = moved
    for term in tracked.flesh.terms:
        check_term(term, x, controls)


def test_gradient_and_hessian_match_differences(tracked, moved):
    x, controls, step = moved
    flesh = tracked.flesh
    h = 1e-6
    ahead, behind = (flesh.add_motion(x, sign * h * step) for sign in (1, -1))
    slope = (flesh.energy(ahead, controls) - flesh.energy(behind, controls)) / (2.0 * h)
    assert flesh.gradient(x, controls) @ step == pytest.approx(slope, rel=1e-6)
    change = (flesh.gradient(ahead, controls) - flesh.gradient(behind, controls)) / (2.0 * h)
    curvature = flesh.hessian(x, controls) @ step
    np.testing.assert_allclose(curvature, change, atol=1e-6 * np.abs(change).max())
    # the springs have a say in both
    without = controls.copy()
    without[-tracked.springs.centre.size :] = x[tracked.springs.vertices[:, 0]].ravel()
    assert abs(flesh.gradient(x, without) @ step - slope) > 0.01 * abs(slope)
    of_springs = np.zeros((len(flesh.rest), 3))
    of_springs[tracked.springs.vertices[:, 0]] = tracked.springs.stiffness[:, None]
    share = of_springs.ravel()[flesh.free_coordinates] * step
    assert np.abs(share).max() > 0.01 * np.abs(change).max()


def test_forces_by_control_match_differences(tracked, moved):
    x, controls, _ = moved
    flesh = tracked.flesh
    h = 1e-6
    random = np.random.default_rng(8)
    matrix = flesh.forces_by_control(x, controls)
    places = np.arange(len(controls) - tracked.springs.centre.size, len(controls))
    for chosen in (np.arange(places[0]), places):
        way = np.zeros(len(controls))
        way[chosen] = random.standard_normal(len(chosen))
        ahead, behind = (flesh.gradient(x, controls + sign * h * way) for sign in (1, -1))
        change = (ahead - behind) / (2.0 * h)
        assert np.abs(change).max() > 0.1
        np.testing.assert_allclose(matrix @ way, change, atol=1e-6 * np.abs(change).max())


def test_forces_by_stretches_and_places_are_those_by_control(tracked, moved):
    x, controls, _ = moved
    by_control = tracked.flesh.forces_by_control(x, controls)
    count = 6 * len(tracked.flesh.tets)
    ways = np.random.default_rng(9).standard_normal((2, 6))
    found = tracked.forces_by_stretch(x, controls, ways)
    assert found.shape == (tracked.flesh.size, 2)
    for muscle in range(2):
        shares = tracked.S[:, [1 + muscle]].toarray()
        expected = by_control[:, :count] @ (shares * ways[muscle]).ravel()
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(found[:, [muscle]].toarray()[:, 0], expected, atol=1e-12)
    by_place = tracked.forces_by_place.toarray()
    np.testing.assert_array_equal(by_place, by_control[:, count:].toarray())


def test_springs_are_as_firm_as_there_is_muscle():
    model = tracked_block()
    flesh = Face(model).flesh
    plain = spring_stiffness(flesh, model.weights, np.ones(2), 2.0)
    # all of them together: mu / l^2 times the volume of the muscles
    share = np.asarray(model.weights[:, 1:].sum(axis=1))
    assert np.isclose(plain.sum(), flesh.volumes @ share / 4.0)
    assert np.allclose(spring_stiffness(flesh, model.weights, np.ones(2), 1.0), 4.0 * plain)
    left = spring_stiffness(flesh, model.weights, np.array([1.0, 0.0]), 2.0)
    right = spring_stiffness(flesh, model.weights, np.array([0.0, 1.0]), 2.0)
    assert np.allclose(left + right, plain)
    assert left[model.rest[:, 0] == 50.0].max() == 0.0


def test_flesh_without_muscles_has_no_springs():
    model = tracked_block()
    passive = sp.csr_array(model.weights.copy())
    passive.data = np.where(passive.indices == 0, 1.0, 0.0)
    tracked = TrackedFlesh.of(Face(model).flesh, passive, np.ones(2), 2.0)
    assert len(tracked.springs.vertices) == 0
    controls = tracked.controls(np.tile(IDENTITY, (2, 1)), model.rest)
    assert np.allclose(tracked.flesh.gradient(model.rest, controls), 0.0, atol=1e-9)
