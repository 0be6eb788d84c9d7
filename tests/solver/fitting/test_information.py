"""What data tell of controls: dense formulas, further rows, and coverage of the intervals."""

import numpy as np
import pytest

from solver.errors import SolveError
from solver.fitting.information import Posterior
from solver.surface import Floats


def problem(rows: int = 12) -> tuple[Floats, Floats, Floats]:
    rng = np.random.default_rng(0)
    size = 8
    root = rng.normal(size=(size, size))
    precision = root @ root.T + 0.5 * np.eye(size)
    return rng.normal(size=(rows, size)), rng.uniform(0.3, 1.0, rows), precision


def test_a_posterior_is_that_of_the_dense_formulas() -> None:
    jacobian, sd, precision = problem()
    found = Posterior.of(jacobian, sd, precision)
    # Kalman's form of the same covariance, by the prior's covariance and the data's
    before = np.linalg.inv(precision)
    gain = before @ jacobian.T @ np.linalg.inv(jacobian @ before @ jacobian.T + np.diag(sd**2))
    after = before - gain @ jacobian @ before
    assert np.allclose(found.covariance, after, rtol=1e-10, atol=1e-12)
    assert np.allclose(found.sd**2, np.diag(after))
    # the averaging kernel's diagonal, in the units of a prior without correlations
    flat = Posterior.of(jacobian, sd, np.diag(np.diag(precision)))
    kernel = np.eye(8) - flat.covariance @ np.diag(np.diag(precision))
    assert np.allclose(flat.information, np.diag(kernel))
    groups = np.arange(8).reshape(4, 2)
    share = 1.0 - np.diag(after)[groups].sum(1) / np.diag(before)[groups].sum(1)
    assert np.allclose(found.information_of(groups), share)


def test_what_no_row_sees_keeps_its_prior_and_unlike_units_do_no_harm() -> None:
    jacobian, sd, precision = problem()
    units = 10.0 ** np.arange(-4, 4)
    scaled = Posterior.of(jacobian / units, sd, precision / np.outer(units, units))
    assert np.allclose(scaled.information, Posterior.of(jacobian, sd, precision).information)
    jacobian[:, 3] = 0.0
    found = Posterior.of(jacobian, sd, np.eye(8))
    assert found.information[3] == 0.0
    assert np.allclose(Posterior.of(jacobian, np.full(12, np.inf), precision).information, 0.0)


def test_pairs_that_act_alike_are_correlated() -> None:
    jacobian, sd, _ = problem(rows=40)
    jacobian[:, 5] = jacobian[:, 2]
    [(i, j, correlation)] = Posterior.of(jacobian, 0.1 * sd, np.eye(8)).correlated_pairs()
    assert (i, j) == (2, 5)
    assert correlation < -0.95


def test_further_data_are_as_good_as_all_at_once() -> None:
    jacobian, sd, precision = problem()
    rows = np.random.default_rng(1).normal(size=(3, 8))
    both = Posterior.of(np.vstack([jacobian, rows]), np.append(sd, [0.5] * 3), precision)
    after = Posterior.of(jacobian, sd, precision).after(rows.T @ rows / 0.25)
    assert np.allclose(after.covariance, both.covariance)


def test_a_greedy_choice_is_the_best_at_every_step() -> None:
    jacobian, sd, precision = problem()
    now = Posterior.of(jacobian, sd, precision)
    candidates = np.random.default_rng(2).normal(size=(30, 3, 8))
    noise = np.random.default_rng(3).uniform(0.2, 2.0, (30, 3))
    chosen = now.greedy(candidates, 4, noise)
    for number, gain in chosen:
        after = [
            now.after(rows.T @ (rows / each[:, None] ** 2))
            for rows, each in zip(candidates, noise, strict=True)
        ]
        dense = [each.information.sum() for each in after]
        assert number == int(np.argmax(dense))
        assert np.isclose(gain, dense[number] - now.information.sum())
        now = after[number]


def test_intervals_of_95_percent_hold_the_truth_as_often() -> None:
    jacobian, sd, precision = problem(rows=10)
    found = Posterior.of(jacobian, sd, precision)
    rng = np.random.default_rng(4)
    truth = rng.normal(size=(4000, 8)) @ np.linalg.cholesky(np.linalg.inv(precision)).T
    data = truth @ jacobian.T + sd * rng.normal(size=(4000, 10))
    estimate = data / sd**2 @ jacobian @ found.covariance
    inside = np.abs(estimate - truth) <= 1.96 * found.sd
    assert 0.93 < inside.mean() < 0.97
    assert ((inside.mean(axis=0) > 0.93) & (inside.mean(axis=0) < 0.97)).all()


def test_a_prior_that_is_none_is_refused() -> None:
    jacobian, sd, precision = problem()
    for wrong in (np.zeros((8, 8)), -precision, np.full((8, 8), np.nan)):
        with pytest.raises(SolveError) as error:
            Posterior.of(jacobian, sd, wrong)
        assert error.value.code == "solve.not_finite"
