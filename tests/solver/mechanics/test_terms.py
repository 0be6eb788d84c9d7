"""A term of its own beside the law: muscles as fibres in tets, driven by one number each."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.mechanics import equilibrium
from solver.mechanics.boundary import BoundaryRates
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import analyse
from solver.mechanics.response import Response, SparseControls
from solver.mechanics.terms import RestingTerm, force_columns
from tests.solver.block import block_model


class Fibres:
    """E = sum_e a_m(e) V_e |F_e f_e|^2 / 2 over entries e, each a tet, a muscle and a fibre."""

    def __init__(self, flesh, tets, muscles, fibres, count):
        self.vertices = flesh.tets[tets]
        self.muscles = muscles
        self.count = count
        # F f = sum_v x_v (grad N_v . f)
        self.along = np.einsum("evi,ei->ev", flesh.gradients[tets], fibres)
        self.volumes = 30.0 * flesh.volumes[tets]

    def energy(self, x, controls):
        stretched = np.einsum("ev,evi->ei", self.along, x[self.vertices])
        weights = controls[self.muscles] * self.volumes
        return 0.5 * float(weights @ (stretched**2).sum(axis=1))

    def per_muscle(self, x):
        stretched = np.einsum("ev,evi->ei", self.along, x[self.vertices])
        return self.volumes[:, None, None] * self.along[:, :, None] * stretched[:, None]

    def forces(self, x, controls):
        return controls[self.muscles, None, None] * self.per_muscle(x)

    def blocks(self, x, controls, *, project=0.0, some=None):
        u, v = np.triu_indices(4)
        weights = controls[self.muscles] * self.volumes
        found = (weights[:, None] * self.along[:, u] * self.along[:, v])[..., None, None]
        return (found * np.eye(3))[slice(None) if some is None else some]

    def forces_by_control(self, x, controls):
        columns = force_columns(self.per_muscle(x), self.vertices, x.size)
        entries = np.arange(len(self.muscles))
        shape = (len(entries), self.count)
        return columns @ sp.csr_array((np.ones(len(entries)), (entries, self.muscles)), shape)


@pytest.fixture(scope="module")
def muscled():
    """The block, two muscles along x, some tets in both."""
    model = block_model()
    flesh = Flesh(model.rest, model.tets, np.concatenate([model.cranium, model.mandible]))
    centre = model.rest[model.tets].mean(axis=1)[:, 0]
    tets = [np.flatnonzero(centre < 30.0), np.flatnonzero(centre > 20.0)]
    muscles = np.repeat([0, 1], [len(each) for each in tets])
    fibres = np.tile([1.0, 0.0, 0.0], (len(muscles), 1))
    term = Fibres(flesh, np.concatenate(tets), muscles, fibres, 2)
    return flesh.driven_by(RestingTerm(flesh.elastic, flesh.passive()), np.zeros(2)).plus(
        term
    ), model


def test_derivatives_match_finite_differences(muscled):
    flesh, _ = muscled
    rng = np.random.default_rng(1)
    x = flesh.rest + 0.3 * rng.standard_normal(flesh.rest.shape)
    q = np.array([0.4, 0.7])
    h = 1e-6
    direction = rng.standard_normal(flesh.size)
    ends = [flesh.add_motion(x, sign * h * direction) for sign in (1, -1)]
    slope = (flesh.energy(ends[0], q) - flesh.energy(ends[1], q)) / (2 * h)
    assert abs(slope - flesh.gradient(x, np.zeros(2)) @ direction) > 1.0
    assert flesh.gradient(x, q) @ direction == pytest.approx(slope, rel=1e-6)
    change = (flesh.gradient(ends[0], q) - flesh.gradient(ends[1], q)) / (2 * h)
    exact = flesh.hessian(x, q) @ direction
    np.testing.assert_allclose(exact, change, atol=1e-6 * np.abs(change).max())
    by_q = flesh.forces_by_control(x, q).toarray()
    for k in (0, 1):
        step = h * np.eye(2)[k]
        change = (flesh.gradient(x, q + step) - flesh.gradient(x, q - step)) / (2 * h)
        assert np.abs(change).max() > 1.0
        np.testing.assert_allclose(by_q[:, k], change, atol=1e-6 * np.abs(change).max())


def test_muscles_contract_and_the_answer_is_that_of_the_equilibrium(muscled):
    flesh, model = muscled
    linear = analyse(flesh.hessian(flesh.rest, flesh.passive()))
    q = np.array([0.5, 0.2])
    h = 1e-5

    def solved(q, held=0.0):
        x = flesh.rest.copy()
        x[model.mandible, 2] += held
        return equilibrium.solve_equilibrium(flesh, linear, x, q, tolerance=1e-13).x

    x = solved(q)
    assert np.abs(x - flesh.rest).max() > 1.0
    held = np.zeros((len(flesh.held), 3, 3))
    held[np.isin(flesh.held, model.mandible), 2, 2] = 1.0
    rates = sp.eye_array(2, 3, format="csr")
    boundary = BoundaryRates(held, np.zeros((5, 3)))
    motions = Response.exact(flesh, x, q, linear=linear).motions(
        SparseControls.of(flesh, x, q, rates, boundary)
    )
    expected = [(solved(q + h * e) - solved(q - h * e)) / (2 * h) for e in np.eye(2)]
    expected.append((solved(q, h) - solved(q, -h)) / (2 * h))
    for k in range(3):
        assert np.abs(expected[k]).max() > 0.1
        scale = np.abs(expected[k]).max()
        np.testing.assert_allclose(motions[:, :, k], expected[k], atol=1e-6 * scale)
