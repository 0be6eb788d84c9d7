"""One tet far from rest: stress, Hessian, activation derivative against finite differences.

The switch is run as Python: what numba compiled of it may be older than a law that has changed.
"""

from typing import get_args

import numpy as np
import pytest

from solver.mechanics import laws
from solver.mechanics.elements import empty_modes
from solver.mechanics.linalg3 import cofactor, polar, signed_svd, stretch

MU = 1.3
LAM = 0.7
KAPPA = 1.7
BARRIER = 5.0
STEP = 1e-6
LAWS = range(len(get_args(laws.Law)))
IDENTITY = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


def activation_matrix(a):
    return a[[[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def density(F, a, law=laws.COROTATED, lam=LAM):
    return laws.density.py_func(law, tuple(F.ravel()), tuple(a), (MU, lam, KAPPA, BARRIER))


def stress(F, a, law):
    return np.array(laws.stress.py_func(law, tuple(F.ravel()), tuple(a), (MU, LAM, KAPPA, BARRIER)))


def hessian(F, a, law, *, project=0.0, kappa=KAPPA):
    modes = empty_modes()
    moduli = (MU, LAM, kappa, BARRIER)
    count, B, H = laws.hessian_modes.py_func(
        law, tuple(F.ravel()), tuple(a), moduli, project, modes
    )
    metric = np.kron(np.eye(3), activation_matrix(np.array(B)))
    # cof is quadratic: its derivative is linear in where it is taken
    bending = central(lambda G: np.array(cofactor(tuple(G.ravel()))), np.reshape(H, (3, 3)))
    return metric + modes.left[:count].T @ modes.right[:count] + bending


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
        a = IDENTITY + 0.3 * rng.standard_normal(6)
        A = activation_matrix(a)
        if np.abs(A @ F.T @ F - F.T @ F @ A).max() > 0.3:
            found.append((F, a))
    return found


def allowed(a, law):
    """Return an activation with a volume for laws that need one."""
    return IDENTITY + 0.3 * (a - IDENTITY) if laws.needs_volume(law) else a


@pytest.mark.parametrize("law", LAWS, ids=get_args(laws.Law))
@pytest.mark.parametrize(("F", "a"), states())
def test_derivatives_match_finite_differences(F, a, law):
    a = allowed(a, law)
    by_F = central(lambda G: np.array([density(G, a, law)]), F).ravel()
    assert np.abs(by_F).max() > 0.1
    np.testing.assert_allclose(stress(F, a, law), by_F, rtol=0, atol=1e-6 * np.abs(by_F).max())

    by_FF = central(lambda G: stress(G, a, law), F)
    assert np.abs(by_FF).max() > 1.0
    np.testing.assert_allclose(hessian(F, a, law), by_FF, rtol=0, atol=1e-6 * np.abs(by_FF).max())

    exact = np.empty((6, 9))
    modes = empty_modes()
    moduli = (MU, LAM, KAPPA, BARRIER)
    laws.stress_by_activation.py_func(law, tuple(F.ravel()), tuple(a), moduli, modes, exact)
    numeric = np.empty_like(exact)
    for entry in range(6):
        step = np.zeros(6)
        step[entry] = STEP
        ends = [stress(F, a + sign * step, law) for sign in (1, -1)]
        numeric[entry] = (ends[0] - ends[1]) / (2 * STEP)
    assert np.abs(numeric).max() > 0.1
    np.testing.assert_allclose(exact, numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("law", LAWS, ids=get_args(laws.Law))
@pytest.mark.parametrize(("F", "a"), states())
def test_projected_hessian_is_positive_semidefinite_and_exact_where_the_raw_one_is(F, a, law):
    a = allowed(a, law)
    projected = hessian(F, a, law, project=1.0)
    mixed = 0.7 * hessian(F, a, law) + 0.3 * projected
    np.testing.assert_allclose(
        hessian(F, a, law, project=0.3), mixed, atol=1e-7 * np.abs(mixed).max()
    )
    assert np.linalg.eigvalsh(0.5 * (projected + projected.T)).min() > -1e-9
    if law != laws.COROTATED:
        return
    stretched = np.diag([1.3, 1.2, 1.4])
    np.testing.assert_allclose(
        hessian(stretched, IDENTITY, law, project=1.0, kappa=0.0),
        hessian(stretched, IDENTITY, law, kappa=0.0),
        atol=1e-9,
    )


@pytest.mark.parametrize("law", LAWS)
def test_rest_is_free_of_stress_and_has_lames_constants(law):
    name = get_args(laws.Law)[law]
    mu, lam = (float(each[0]) for each in laws.own_moduli(name, np.array([MU]), np.array([LAM])))
    moduli = (mu, lam, KAPPA, BARRIER)
    rest = tuple(IDENTITY)

    def stress_at(F):
        return np.array(laws.stress.py_func(law, tuple(F.ravel()), rest, moduli))

    assert np.abs(stress_at(np.eye(3))).max() < 1e-12
    strain = np.random.default_rng(3).standard_normal((3, 3))
    strain = strain + strain.T
    trace = np.trace(strain) * np.eye(3)
    found = (stress_at(np.eye(3) + STEP * strain) - stress_at(np.eye(3) - STEP * strain)) / (
        2 * STEP
    )
    expected = 2 * MU * strain + (LAM + 2 * KAPPA) * trace
    np.testing.assert_allclose(found.reshape(3, 3), expected, rtol=1e-6, atol=1e-6)


def test_energy_vanishes_where_the_activation_is_met():
    a = np.array([0.8, 0.1, 0.0, 1.1, -0.05, 1.05])
    R = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    R *= np.sign(np.linalg.det(R))
    assert density(R @ activation_matrix(a), a, lam=0.0) == pytest.approx(0.0, abs=1e-14)


@pytest.mark.parametrize("law", LAWS, ids=get_args(laws.Law))
def test_inverted_elements_have_infinite_energy(law):
    assert density(np.diag([1.0, 1.0, -0.1]), IDENTITY, law) == np.inf


def test_polar_decomposition_of_all_kinds_of_matrices():
    """Near rotations, far from them, nearly flat, nearly lines, and reflections."""
    rng = np.random.default_rng(11)
    cases = [scale * rng.standard_normal((3, 3)) for scale in (1e-3, 1.0, 1e3) for _ in range(40)]
    cases += [np.eye(3) + 0.1 * rng.standard_normal((3, 3)) for _ in range(40)]
    for small in (1e-1, 1e-3, 1e-5, 1e-7, 0.0):
        U, V = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
        cases += [U @ np.diag([1.0, 0.7, small]) @ V, U @ np.diag([1.0, 2.0 * small, small]) @ V]
    for G in cases:
        t, R, Y = polar(tuple(G.ravel()))
        R = np.array(R).reshape(3, 3)
        U, s, Vt = np.linalg.svd(G)
        sign = np.sign(np.linalg.det(U @ Vt))
        U[:, 2] *= sign
        s[2] *= sign
        gap = s[1] + s[2]
        assert t == pytest.approx(s.sum(), rel=1e-12)
        assert stretch(tuple(G.ravel())) == pytest.approx(t, rel=1e-14)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-10)
        assert np.linalg.det(R) == pytest.approx(1.0)
        if gap > 1e-6 * s[0]:
            np.testing.assert_allclose(R, U @ Vt, atol=1e-13 * s[0] / gap)
            P = R.T @ G
            inverse = np.linalg.inv(np.trace(P) * np.eye(3) - P)
            np.testing.assert_allclose(
                Y, inverse[np.triu_indices(3)], atol=1e-10 * np.abs(inverse).max() * s[0] / gap
            )


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e9])
def test_svd_of_reflections_rank_one_and_repeated_values(scale):
    rng = np.random.default_rng(3)
    cases = [rng.standard_normal((3, 3)) for _ in range(50)]
    cases += [np.diag([1.0, 1.0, -1.0]), np.diag([2.0, 2.0, 2.0]), np.diag([1.0, 1e-9, 1e-9])]
    for case in cases:
        G = scale * case
        U = np.empty((3, 3))
        s = np.empty(3)
        V = np.empty((3, 3))
        signed_svd(G, U, s, V)
        np.testing.assert_allclose(U @ np.diag(s) @ V.T, G, atol=1e-13 * np.abs(G).max())
        assert np.linalg.det(U) == pytest.approx(1.0)
        assert np.linalg.det(V) == pytest.approx(1.0)
