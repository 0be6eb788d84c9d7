"""The solver that was asked for, and IPOPT where it fails: both find the same."""

import numpy as np
import pytest

from solver.errors import SolveError
from solver.fitting import fallback
from solver.fitting.activation import ActivationOptions
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from tests.solver.block import block_model

STOP = ActivationOptions(25, 1e-6)


@pytest.fixture(scope="module")
def problem():
    """Return what a fit takes, for two contracted muscles and an open jaw."""
    face = Face(block_model())
    a = np.array([[0.8, 0.05, 0.0, 1.1, 0.0, 1.1], [0.9, 0.0, 0.0, 1.05, 0.0, 1.05]])
    pose = Pose(a, np.array([0.1, 0.02, 0.2, -0.5, 0.4]))
    target = Target.from_points(face.face_points(face.continuation(face.rest, pose).x))
    regulariser = Regulariser(1e-3, 1e-2, 1e-6, face.rest_pose())
    return face, SkinDistance(face, target), regulariser, STOP


def test_both_solvers_find_the_same(problem):
    reduced, full = (fallback.fit(*problem, solver) for solver in ("reduced", "ipopt"))
    assert (reduced.solver, reduced.status, reduced.notices) == ("reduced", "converged", ())
    assert (full.solver, full.status, full.notices) == ("ipopt", "converged", ())
    assert full.objective == pytest.approx(reduced.objective, rel=1e-3)
    face, data, regulariser, _ = problem
    assert full.objective < 0.01 * fallback.activation.objective(data, regulariser, face.rest)


@pytest.mark.parametrize("error", [SolveError("solve.far", "too far"), np.linalg.LinAlgError("no")])
def test_ipopt_takes_over_and_says_why(problem, monkeypatch, error):
    def fail(*_args, **_more):
        raise error

    full = fallback.fit(*problem, "ipopt")
    monkeypatch.setattr(fallback.activation, "fit", fail)
    steps = []
    found = fallback.fit(*problem, listen=lambda iteration, value: steps.append((iteration, value)))
    assert (found.solver, found.status) == ("ipopt", "converged")
    assert found.objective == full.objective
    (notice,) = found.notices
    assert notice.code == "solve.fallback"
    assert str(error) in notice.message
    assert steps[-1][1] < steps[0][1]


def test_within_limits_a_fit_that_breaks_down_stays_where_it_began(problem, monkeypatch):
    face, data, regulariser, options = problem
    within = face.driven_as(Admissible())
    data = SkinDistance(within, data.target)
    begun = fallback.fit(within, data, regulariser, options)

    def fail(*_args, **_more):
        raise SolveError("solve.far", "too far")

    monkeypatch.setattr(fallback.activation, "fit", fail)
    for start, most in ((begun.state, 1.001 * begun.objective), (None, np.inf)):
        found = fallback.fit(within, data, regulariser, options, start=start)
        assert (found.solver, found.status) == ("reduced", "failed")
        assert found.objective <= most
    assert found.objective > begun.objective


def test_out_of_iterations_the_best_is_kept(problem):
    """One iteration of IPOPT ends nowhere: what is kept is better than rest, and settled."""
    once = fallback.FallbackOptions(iterations=1, heavier=(1.0,))
    face, data, regulariser, _ = problem
    few = ActivationOptions(1, 1e-6)
    found = fallback.fit(face, data, regulariser, few, "ipopt", ipopt=once)
    assert found.status == "stopped"
    assert [notice.code for notice in found.notices] == ["ipopt.failed"]
    assert found.objective < 0.5 * fallback.activation.objective(data, regulariser, face.rest)
    assert found.state.equilibrium.residual < 1e-6
    assert face.flesh.count_inverted(found.state.x) == 0
