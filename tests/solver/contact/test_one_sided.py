"""One-sided contact: rows of teeth and eyeballs push skin out, from any depth and at any jaw."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.contact.obstacles import Arch, Eyeball
from solver.contact.one_sided import OneSided, OneSidedOptions, free_depths
from solver.mechanics.boundary import Boundary, BoundaryRates, move_jaw
from solver.model import JawFrame
from tests.solver.ball import ball
from tests.solver.teeth import HEIGHT, RADIUS, fan, row_of_teeth

JAW = JawFrame(np.array([0.0, 30.0, -60.0]), np.eye(3))


def kept(obstacle, points, carried=None):
    count = len(points)
    rows = sp.eye_array(count, format="csr")
    free = np.full(count, -OneSidedOptions.margin_mm)
    return OneSided(obstacle, rows, np.zeros((count, 3)), free, np.full(count, 7.0), carried)


def at(b):
    return Boundary(np.empty((0, 3)), b)


def test_a_row_of_teeth_is_as_deep_as_its_wall():
    arch = Arch.of(row_of_teeth())
    depth, out, counts, _ = arch.depths(fan(RADIUS - 3.0))
    # along the ray from the arch's own axis, which leaves the wall at a slant
    assert np.all((depth > 2.8) & (depth < 4.5))
    assert depth[10] == pytest.approx(3.0, abs=0.1)
    np.testing.assert_allclose(out[10], [0.0, 0.0, -1.0], atol=0.05)
    assert (counts == 1.0).all()
    assert (arch.depths(fan(RADIUS + 1.0))[0] < -0.9).all()
    assert not arch.depths(fan(RADIUS - 3.0, HEIGHT / 2 + 1.0))[2].any()


@pytest.mark.parametrize("height", [0.0, HEIGHT / 2 - 0.6])
def test_skin_behind_teeth_comes_out_to_the_front(height):
    points = fan(RADIUS - 5.0, height)
    potential = kept(Arch.of(row_of_teeth()), points)
    potential.place(at(np.zeros(5)))
    assert len(potential.behind(points, np.zeros(5), 0.2)) == len(points)
    x = points
    for _ in range(200):
        x = x - potential.gradient(x) / 14.0
    assert potential.value(x) < 1e-3
    assert not len(potential.behind(x, np.zeros(5), 0.2))
    # near its border the way out leads over the edge as well
    assert np.all((np.hypot(x[:, 0], x[:, 2]) > RADIUS - 0.1) | (x[:, 1] > HEIGHT / 2 - 0.4))


@pytest.mark.parametrize("carried", [None, JAW])
@pytest.mark.parametrize("height", [0.0, HEIGHT / 2 - 0.6])
def test_derivatives_of_teeth_match_differences(height, carried):
    b = np.array([0.05, 0.02, 0.4, -0.3, 0.2])
    points = fan(RADIUS - 2.0, height)
    if carried is not None:
        points = move_jaw(JAW, points, b)
    check_derivatives(kept(Arch.of(row_of_teeth()), points, carried), points, b)


def test_derivatives_of_an_eye_match_differences():
    eye = Eyeball.of(ball([3.0, 2.0, 1.0], 12.0).vertices)
    np.testing.assert_allclose([*eye.centre, eye.radius], [3.0, 2.0, 1.0, 12.0], atol=1e-6)
    points = np.array([3.0, 2.0, 1.0]) + fan(11.0)
    check_derivatives(kept(eye, points), points, np.zeros(5))


def check_derivatives(potential, x, b):
    step = np.random.default_rng(1).normal(size=x.shape) + np.array([0.0, 0.0, 1.0])
    potential.place(at(b))
    small = 1e-5 * step
    slope = (potential.value(x + small) - potential.value(x - small)) / 2e-5
    assert abs(slope) > 1.0
    assert np.sum(potential.gradient(x) * step) == pytest.approx(slope, rel=1e-4)
    change = np.sum(step * (potential.gradient(x + small) - potential.gradient(x - small))) / 2e-5
    curvature = step.ravel() @ (potential.hessian(x) @ step.ravel())
    assert curvature > 1.0
    # Gauss-Newton: without the field's own curvature
    assert curvature == pytest.approx(change, rel=0.3)
    exact = step.ravel() @ (potential.curvature(x) @ step.ravel())
    assert exact == pytest.approx(change, rel=1e-4)
    before = potential.gradient(x)
    goal = b + 1e-5 * np.array([1.0, 0.5, 2.0, 3.0, 30.0])
    pull = potential.pull(x, at(goal))
    potential.place(at(goal))
    change = potential.gradient(x) - before
    if potential._carried is None:
        assert not pull.any()
        assert not change.any()
    else:
        assert np.abs(change).max() > 1e-4
        np.testing.assert_allclose(pull, change, atol=0.2 * np.abs(change).max())
    rates = BoundaryRates(np.empty((0, 3, 5)), np.eye(5))
    for k in range(5):
        ends = []
        for sign in (1, -1):
            potential.place(at(goal + sign * 1e-5 * np.eye(5)[k]))
            ends.append(potential.gradient(x))
        expected = (ends[0] - ends[1]) / 2e-5
        if potential._carried is not None:
            assert np.abs(expected).max() > 1e-2
        potential.place(at(goal))
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(
            potential.by_boundary(x, rates)[:, :, k], expected, atol=1e-4 * scale
        )


def test_the_neutral_is_pushed_by_nothing():
    arch = Arch.of(row_of_teeth())
    rest = np.vstack(
        [fan(RADIUS - 1.0), fan(RADIUS + OneSidedOptions.margin_mm / 2), fan(RADIUS + 1.0)]
    )
    rows = sp.eye_array(len(rest), format="csr")
    free = free_depths(arch, rest, -OneSidedOptions.margin_mm)
    potential = OneSided(arch, rows, np.zeros_like(rest), free, np.ones(len(rest)))
    assert potential.value(rest) == 0.0
    assert not len(potential.behind(rest, np.zeros(5), 0.2))
    assert potential.value(rest - [0.0, 0.0, 1.5]) > 1.0
