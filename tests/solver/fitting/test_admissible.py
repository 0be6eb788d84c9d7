"""Activations that muscles can make: the barrier, the small problem within, and fits by it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import NonlinearConstraint, minimize

from solver.errors import InputError, SolveError
from solver.fitting import activation, fallback, geometry
from solver.fitting.activation import ActivationOptions
from solver.fitting.controls import Layout, jaw_block
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits, AdmissibleSet
from solver.fitting.drives.six_numbers import activation_block
from solver.fitting.face import Face, Pose
from solver.fitting.geometry import GeometryOptions
from solver.fitting.interior_point import interior_step
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.steps import FeasibleStepOptions, LinearisedOptions, linearised_step
from solver.fitting.stretches import determinants, fibre_tensors, matrices
from solver.mechanics.flesh import IDENTITY
from tests.solver.block import block_model, poses
from tests.solver.simulation.test_fibres import fibred_block

LIMITS = AdmissibleLimits()


def random_set(count, seed=0):
    """Return a set of muscles with fibres of a main direction, the last without any."""
    rng = np.random.default_rng(seed)
    along = rng.standard_normal((count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    tensors = 0.8 * along[:, :, None] * along[:, None] + 0.2 * np.eye(3) / 3.0
    tensors[-1] = np.nan
    return AdmissibleSet(LIMITS, tensors)


def wild(count, seed=1, size=0.6):
    return IDENTITY + np.random.default_rng(seed).normal(0.0, size, (count, 6))


def test_barrier_has_its_derivatives_and_no_slope_at_rest():
    admissible = random_set(12)
    # far from the bounds, where differences are good to many digits
    a = admissible.nearest(wild(12), 0.2)
    change = np.random.default_rng(2).standard_normal(a.shape)
    step = 1e-6
    ends = [a + sign * step * change for sign in (1.0, -1.0)]
    by_value = (admissible.value(ends[0]) - admissible.value(ends[1])) / (2.0 * step)
    assert abs(by_value) > 10.0
    assert np.isclose(np.sum(admissible.gradient(a) * change), by_value, rtol=1e-6)
    by_slope = (admissible.gradient(ends[0]) - admissible.gradient(ends[1])) / (2.0 * step)
    seen = np.einsum("jqr,jr->jq", admissible.hessian(a), change)
    # near the upper bound of volume alone is the set not convex
    margins = admissible.margins(a)
    convex = margins[:, 7] < margins[:, 8]
    assert convex.sum() >= 3
    assert np.abs(by_slope[convex]).max() > 10.0
    np.testing.assert_allclose(seen[convex], by_slope[convex], rtol=1e-5, atol=1e-3)
    assert np.linalg.eigvalsh(admissible.hessian(a)).min() > 0.0
    loose = replace(admissible, limits=LIMITS.loosen(0.3))
    for each in (admissible, loose):
        assert np.abs(each.gradient(np.tile(IDENTITY, (12, 1)))).max() < 1e-10


def test_what_is_outside_is_brought_in_and_what_is_inside_stays():
    admissible = random_set(40)
    a = wild(40)
    inside = admissible.nearest(a, 1e-3)
    assert not admissible.contains(a)
    assert admissible.contains(inside)
    np.testing.assert_array_equal(admissible.nearest(inside, 1e-3), inside)
    # muscles that are hardly beyond a bound hardly move
    a = inside.copy()
    a[:, 0] += 1e-3
    assert np.abs(admissible.nearest(a, 1e-4) - a).max() < 0.01


def test_a_step_is_the_best_within_the_bounds():
    """Against SLSQP on the same model, with the jaw bounded in a box as well."""
    admissible = random_set(2, seed=5)
    rng = np.random.default_rng(7)
    jaw = replace(jaw_block(), lower=np.full(5, -0.1), upper=np.full(5, 0.2))
    layout = Layout((replace(activation_block(2), feasible=admissible), jaw))
    root = rng.standard_normal((layout.size, layout.size))
    hessian = root @ root.T + np.eye(layout.size)
    goal = layout.join([wild(2, seed=8), rng.standard_normal(5)])
    q = layout.rest
    gradient = -hessian @ (goal - q)
    found = interior_step(layout.bounds, hessian, gradient, q).change

    def model(step):
        return gradient @ step + 0.5 * step @ hessian @ step

    def margins_of(step):
        return admissible.margins((q + step)[:12].reshape(2, 6)).ravel()

    margins = NonlinearConstraint(margins_of, 0.0, np.inf)
    box = NonlinearConstraint(lambda s: np.append(s[12:] + 0.1, 0.2 - s[12:]), 0.0, np.inf)
    options = {"maxiter": 500, "ftol": 1e-12}
    known = minimize(
        model, np.zeros(layout.size), constraints=[margins, box], method="SLSQP", options=options
    )
    ends = layout.part("activations", q + found)
    assert admissible.contains(ends)
    assert (admissible.margins(ends) < 1e-3).any()
    assert model(found) < model(np.zeros(layout.size)) - 1.0
    assert model(found) <= known.fun + 1e-4 * abs(known.fun)


@pytest.mark.parametrize("thicker", [1.0, 0.5, 0.0])
def test_a_muscle_may_halve_its_length_and_keep_its_volume(thicker):
    """All around, or as a sheet that keeps its breadth."""
    along = np.diag([1.0, 0.0, 0.0])[None]
    admissible = AdmissibleSet(LIMITS, along)
    shorter = 0.53
    broader = shorter ** (-0.5 * thicker)
    a = IDENTITY.copy()
    a[[0, 3, 5]] = shorter, broader, 1.0 / (shorter * broader)
    np.testing.assert_allclose(determinants(a[None]), 1.0)
    assert admissible.contains(a[None])


def test_margins_have_their_slopes():
    # where no two stretches are the same
    admissible = random_set(12)
    a = wild(12, size=0.1)
    change = np.random.default_rng(2).standard_normal(a.shape)
    step = 1e-6
    ends = [admissible.margins(a + sign * step * change) for sign in (1.0, -1.0)]
    seen = np.einsum("jbk,jk->jb", admissible.linearise(a)[1], change)
    np.testing.assert_allclose(seen, (ends[0] - ends[1]) / (2.0 * step), atol=1e-6)


def test_a_step_to_the_next_frame_is_about_the_best_within_the_bounds():
    """From where another goal has led, and from far outside, in a box as well."""
    admissible = random_set(8, seed=5)
    rng = np.random.default_rng(7)
    jaw = replace(jaw_block(), lower=np.full(5, -0.1), upper=np.full(5, 0.2))
    layout = Layout((replace(activation_block(8), feasible=admissible), jaw))
    bounds = layout.bounds
    root = rng.standard_normal((layout.size, layout.size))
    hessian = root @ root.T + np.eye(layout.size)
    goal = rng.normal(0.0, 0.2, layout.size)
    shift = rng.normal(0.0, 0.02, layout.size)
    begin = -hessian @ goal
    q = layout.rest + interior_step(bounds, hessian, begin, layout.rest).change
    gradient = begin + hessian @ (q - layout.rest) - hessian @ shift
    free = np.linalg.solve(hessian, -gradient)
    assert not bounds.contains(q + free)

    def gain(step, at):
        inside = bounds.clip(at) - at
        step, start = (gradient @ each + 0.5 * each @ hessian @ each for each in (step, inside))
        return start - step

    for at, part in ((q, 0.99), (layout.rest + 9.0 * goal, 0.8)):
        ahead = linearised_step(bounds, hessian, gradient, at)
        assert ahead is not None
        found = ahead.change
        best = interior_step(bounds, hessian, gradient, at).change
        assert bounds.contains(at + found)
        np.testing.assert_allclose(found, bounds.clip(at + found) - at, atol=1e-12)
        assert gain(found, at) > part * gain(best, at) > 0.0


def test_a_nearly_singular_model_is_minimised_too():
    layout = Layout((replace(activation_block(2), feasible=random_set(2, seed=3)), jaw_block()))
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.standard_normal((layout.size, layout.size)))[0]
    gradient = 0.1 * rng.standard_normal(layout.size)
    gains = []
    for condition in (1e3, 1e9):
        hessian = (axes * np.geomspace(1.0, 1.0 / condition, layout.size)) @ axes.T
        hessian += np.diag(np.r_[np.zeros(12), np.ones(5)])
        step = interior_step(layout.bounds, hessian, gradient, layout.rest).change
        gains.append(-(gradient @ step + 0.5 * step @ hessian @ step))
    assert gains[1] >= gains[0] > 0.01
    with pytest.raises(SolveError):
        interior_step(layout.bounds, hessian, gradient, np.full(layout.size, np.nan))


@pytest.mark.parametrize("wrong", [{"fibre": 1.0}, {"shortest": 1.2}, {"volume": 0.9}])
def test_limits_that_exclude_rest_are_refused(wrong):
    with pytest.raises(InputError) as refused:
        AdmissibleLimits(**wrong)
    assert refused.value.code == "limits.rest"


def test_without_fibres_volume_is_kept_and_muscles_may_push():
    admissible = Face(block_model()).driven_by(Admissible(LIMITS)).layout.bounds.feasible
    pushing = np.array([1.2, 0.0, 0.0, 1.2**-0.5, 0.0, 1.2**-0.5])
    swollen = np.array([1.2, 0.0, 0.0, 1.2, 0.0, 1.2])
    assert admissible.contains(np.tile(pushing, (2, 1)))
    assert not admissible.contains(np.stack([pushing, swollen]))


def test_limits_are_not_for_ipopt(face):
    weak = Regulariser(w_a=1e-3, w_v=0.0, w_b=1e-6, prior=face.rest_pose())
    data = SkinDistance(face, Target.from_points(face.face_points(face.rest.x)))
    with pytest.raises(InputError) as refused:
        fallback.fit(face, data, weak, ActivationOptions(3), "ipopt")
    assert refused.value.code == "solver.limits"


def test_a_state_that_cannot_enter_begins_at_rest(free, face, monkeypatch):
    def fail(*_args, **_more):
        raise SolveError("solve.no_convergence", "out of reach")

    push = np.tile([1.4, 0.0, 0.0, 0.9, 0.0, 0.9], (2, 1))
    state = free.continuation(free.rest, Pose(push, np.zeros(5)))
    weak = Regulariser(w_a=1e-3, w_v=0.0, w_b=1e-6, prior=face.rest_pose())
    data = SkinDistance(face, Target.from_points(face.face_points(state.x)))
    monkeypatch.setattr(Face, "newton_continuation", fail)
    monkeypatch.setattr(Face, "continuation", fail)
    assert activation.enter(face, data, weak, state) is face.rest


@pytest.fixture(scope="module")
def free():
    return Face(fibred_block(), tolerance=1e-10)


@pytest.fixture(scope="module")
def face(free):
    return free.driven_by(Admissible(LIMITS))


def data_of(face, pose):
    state = face.continuation(face.rest, pose)
    return SkinDistance(face, Target.from_points(face.face_points(state.x)))


def test_what_muscles_did_is_found_again(free, face):
    admissible = face.layout.bounds.feasible
    pose = poses(1)[0]
    pose = Pose(admissible.nearest(pose.a, 0.2), pose.b)
    weak = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=face.rest_pose())
    stop = ActivationOptions(60, tolerance=1e-9)
    found = activation.fit(face, data_of(free, pose), weak, options=stop).state
    assert admissible.contains(found.pose.a)
    np.testing.assert_allclose(found.pose.a, pose.a, atol=0.02)
    np.testing.assert_allclose(found.pose.b, pose.b, atol=0.02)


@pytest.mark.long
def test_muscles_that_push_are_fitted_as_well_as_muscles_can(free, face):
    """Judged on its own: no fibre, stretch or volume beyond the limits, S being fitted too."""
    push = np.tile([1.4, 0.0, 0.0, 0.9, 0.0, 0.9], (2, 1))
    data = {"push": data_of(free, Pose(push, np.zeros(5)))}
    assert not face.layout.bounds.feasible.contains(push)
    fitted = geometry.fit(free, data, GeometryOptions(rounds=4, within=Admissible(LIMITS)))
    a = fitted.states["push"].pose.a
    stretches = np.linalg.eigvalsh(matrices(a))
    tensors = fibre_tensors(free.model, free.flesh.volumes, fitted.S)
    fibres = np.einsum("jkl,jkl->j", tensors, matrices(a))
    assert fibres.max() < LIMITS.fibre
    assert LIMITS.shortest < stretches.min()
    assert stretches.max() < LIMITS.longest
    assert np.abs(np.log(determinants(a))).max() < np.log(LIMITS.volume)
    assert fitted.endings["push"].status == "converged"
    nothing = data["push"].value(free.rest.x)
    assert fitted.endings["push"].objective < 0.7 * nothing


def test_where_cuts_lead_nowhere_the_interior_point_does():
    """With one cut and all of its gain asked for, a step is the interior point's."""
    layout = Layout((replace(activation_block(8), feasible=random_set(8, seed=5)), jaw_block()))
    rng = np.random.default_rng(7)
    root = rng.standard_normal((layout.size, layout.size))
    hessian = root @ root.T + np.eye(layout.size)
    gradient = -hessian @ rng.normal(0.0, 0.5, layout.size)
    model = layout.bounds, hessian, gradient, layout.rest
    hasty = LinearisedOptions(rounds=1, worth=1.0)
    assert linearised_step(*model, hasty) is None
    steps = layout.steps(hessian, gradient, layout.rest, options=FeasibleStepOptions(hasty))
    found = layout.rest + steps.best(gradient)
    assert layout.bounds.contains(found)
    np.testing.assert_allclose(found, layout.rest + interior_step(*model).change, atol=1e-3)
