"""One tet far from rest: stress, Hessian, activation derivative against finite differences."""

import numpy as np
import pytest

from solver.mechanics import material
from solver.mechanics.svd3 import signed_svd

MU, LAM, KAPPA, BARRIER = 1.3, 0.7, 1.7, 5.0
STEP = 1e-6


def work():
    return np.empty((6, 3, 3))


def activation_matrix(a):
    A = np.empty((3, 3))
    material.symmetric(a, A)
    return A


def stress(F, A):
    P = np.empty((3, 3))
    material.stress(F, A, MU, LAM, KAPPA, BARRIER, work(), P)
    return P


def hessian(F, A, *, project=False, kappa=KAPPA):
    c, W = np.zeros(material.MODES), np.zeros((material.MODES, 3, 3))
    count, curvature = material.hessian_modes(F, A, MU, LAM, kappa, BARRIER, project, work(), c, W)
    H = 2.0 * MU * np.eye(9)
    for k in range(count):
        H += c[k] * np.outer(W[k], W[k])
    return H + curvature * central(lambda G: cofactor(G).ravel(), F)


def cofactor(F):
    out = np.empty((3, 3))
    material.cofactor(F, out)
    return out


def central(function, F):
    """Return the derivative of ``function`` (3, 3) -> (k,) by F, shape (k, 9)."""
    columns = []
    for entry in range(9):
        step = np.zeros(9)
        step[entry] = STEP
        step = step.reshape(3, 3)
        columns.append((function(F + step) - function(F - step)) / (2 * STEP))
    return np.array(columns).T


def states():
    """Deformations and activations that do not commute, some with the barrier acting."""
    rng = np.random.default_rng(7)
    found = []
    while len(found) < 12:
        F = np.eye(3) + 0.4 * rng.standard_normal((3, 3))
        if np.linalg.det(F) < 0.05:
            continue
        if len(found) % 3 == 0:
            F *= np.cbrt(0.2 / np.linalg.det(F))
        a = np.array([1.0, 0, 0, 1, 0, 1]) + 0.3 * rng.standard_normal(6)
        A = activation_matrix(a)
        if np.abs(A @ F.T @ F - F.T @ F @ A).max() > 0.3:
            found.append((F, a))
    return found


@pytest.mark.parametrize(("F", "a"), states())
def test_derivatives_match_finite_differences(F, a):
    A = activation_matrix(a)

    def density(G):
        return np.array([material.density(G, A, MU, LAM, KAPPA, BARRIER, work())])

    by_F = central(density, F).reshape(3, 3)
    assert np.abs(by_F).max() > 0.1
    np.testing.assert_allclose(stress(F, A), by_F, rtol=0, atol=1e-6 * np.abs(by_F).max())

    by_FF = central(lambda G: stress(G, A).ravel(), F)
    assert np.abs(by_FF).max() > 1.0
    np.testing.assert_allclose(hessian(F, A), by_FF, rtol=0, atol=1e-6 * np.abs(by_FF).max())

    exact = np.empty((3, 3, 6))
    material.stress_by_activation(F, A, MU, KAPPA, work(), exact)
    numeric = np.empty_like(exact)
    for entry in range(6):
        step = np.zeros(6)
        step[entry] = STEP
        ends = [stress(F, activation_matrix(a + sign * step)) for sign in (1, -1)]
        numeric[:, :, entry] = (ends[0] - ends[1]) / (2 * STEP)
    assert np.abs(numeric).max() > 0.1
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize(("F", "a"), states())
def test_projected_hessian_is_positive_semidefinite_and_exact_where_the_raw_one_is(F, a):
    A = activation_matrix(a)
    assert np.linalg.eigvalsh(hessian(F, A, project=True)).min() > -1e-9
    stretched = np.diag([1.3, 1.2, 1.4])
    rest = np.eye(3)
    np.testing.assert_allclose(
        hessian(stretched, rest, project=True, kappa=0.0),
        hessian(stretched, rest, kappa=0.0),
        atol=1e-9,
    )


def test_energy_and_stress_vanish_where_the_activation_is_met():
    A = activation_matrix(np.array([0.8, 0.1, 0.0, 1.1, -0.05, 1.05]))
    R = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    R *= np.sign(np.linalg.det(R))
    assert material.density(R @ A, A, MU, 0.0, KAPPA, BARRIER, work()) == pytest.approx(
        0.0, abs=1e-14
    )


def test_inverted_elements_have_infinite_energy():
    F = np.diag([1.0, 1.0, -0.1])
    assert material.density(F, np.eye(3), MU, LAM, KAPPA, BARRIER, work()) == np.inf


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_svd_of_reflections_rank_one_and_repeated_values(scale):
    rng = np.random.default_rng(3)
    cases = [rng.standard_normal((3, 3)) for _ in range(50)]
    cases += [np.diag([1.0, 1.0, -1.0]), np.diag([2.0, 2.0, 2.0]), np.diag([1.0, 1e-9, 1e-9])]
    for case in cases:
        G = scale * case
        U, s, V = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
        signed_svd(G, U, s, V)
        np.testing.assert_allclose(U @ np.diag(s) @ V.T, G, atol=1e-13 * np.abs(G).max())
        assert np.linalg.det(U) == pytest.approx(1.0)
        assert np.linalg.det(V) == pytest.approx(1.0)
