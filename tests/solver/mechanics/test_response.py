"""dx/dq by one factorisation against differences of solved equilibria, contact included."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.contact.barrier import Barrier, ContactSurface
from solver.contact.obstacles import Eyeball
from solver.contact.one_sided import OneSided
from solver.errors import InputError
from solver.fitting.face import Face
from solver.mechanics.boundary import Boundary, BoundaryRates, curvature, move_jaw_back
from solver.mechanics.flesh import Flesh
from solver.mechanics.linear import SOLVERS, analyse
from solver.mechanics.response import Response, SparseControls
from tests.solver.ball import ball
from tests.solver.block import block_model, grid

STEP = 1e-5
Q = np.array([0.1, -0.1, 0.15, 0.4, 0.3, 0.02, 0.01])
PLACES = np.array([[20.0, 20.0, 15.0], [40.0, 10.0, 15.0]])
AXES = np.array([[0.0, 0.0, 1.0], [0.3, 1.0, 0.2]])


class Driven:
    """A block by three controls of its activations, two of the jaw and two of a ball on it."""

    def __init__(self, touched):
        self.face = Face(block_model())
        self.flesh = self.face.flesh
        model = self.face.model
        rng = np.random.default_rng(2)
        self.by_a = sp.random_array((6 * len(model.tets), 3), density=0.2, rng=rng, format="csr")
        self.by_jaw = np.zeros((5, 7))
        self.by_jaw[0, 3] = 0.1
        self.by_jaw[4, 4] = 1.0
        self.potentials = []
        self.glass = ball([0.0, 0.0, 5.0], 5.0)
        self.x = self.settled(Q, self.settled(0.3 * Q, model.rest))
        if touched:
            # just over the skin where it comes to rest alone, the other a little in it
            near, pressed = (self.x[np.abs(model.rest - at).sum(axis=1).argmin()] for at in PLACES)
            shift = near + np.array([0.01, 0.02, 0.04]) - Q[5:] @ AXES
            self.glass = self.glass.with_vertices(self.glass.vertices + shift)
            own = sp.csr_array(sp.eye_array(len(model.rest)))
            front = np.flatnonzero(model.rest[:, 2] == 15.0)
            number = np.arange(30).reshape(6, 5)
            a = number[:-1, :-1]
            b = number[1:, :-1]
            c = number[1:, 1:]
            d = number[:-1, 1:]
            faces = np.concatenate(
                [
                    np.stack([each.ravel() for each in three], axis=1)
                    for three in ((a, b, c), (a, c, d))
                ]
            )
            surface = ContactSurface(
                front, faces, own[front], np.zeros((30, 3)), model.rest[front], np.zeros(30, bool)
            )
            b = self.by_jaw @ Q
            centre = move_jaw_back(model.jaw, pressed[None] + [0.5, 0.2, 8.0], b)[0]
            eye = Eyeball(centre, 8.5)
            pushed = OneSided(
                eye, own[front], np.zeros((30, 3)), np.full(30, -0.1), np.full(30, 50.0), model.jaw
            )
            self.potentials = [Barrier(surface, 1.0, objects=[self.glass]), pushed]

    def state(self, q):
        """Return activations and boundary of controls q (7,)."""
        a = self.flesh.passive() + (self.by_a @ q[:3]).reshape(-1, 6)
        b = self.by_jaw @ q
        glass = self.glass.vertices + q[5:] @ AXES
        return a, Boundary(self.face.held_positions(b), b, (glass,))

    def settled(self, q, x):
        """Return the equilibrium by whole Newton steps, to the last digits."""
        a, boundary = self.state(q)
        x = x.copy()
        x[self.flesh.held] = boundary.held
        for each in self.potentials:
            each.place(boundary)
        for _ in range(30):
            gradient = self.flesh.gradient(x, a)
            for each in self.potentials:
                gradient += each.gradient(x).ravel()[self.flesh.free_coordinates]
            H = self.flesh.hessian(x, a) + self.flesh.free_block(curvature(self.potentials, x))
            step = sp.linalg.spsolve(sp.csc_array(H), -gradient)
            if np.abs(step).max() < 1e-12:
                return x
            x = self.flesh.add_motion(x, step * min(1.0, 0.5 / np.abs(step).max()))
        raise AssertionError("no equilibrium")

    def controls(self, q, x):
        b = self.by_jaw @ q
        held = (self.face.mandible_jacobian(b) @ self.by_jaw)[self.flesh.held]
        objects = np.zeros((len(self.glass.vertices), 3, 7))
        objects[:, :, 5:] = AXES.T
        activations = sp.hstack([self.by_a, sp.csr_array((self.by_a.shape[0], 4))])
        return SparseControls.of(
            self.flesh,
            x,
            self.state(q)[0],
            activations,
            BoundaryRates(held, self.by_jaw, (objects,)),
            self.potentials,
        )


@pytest.fixture(scope="module", params=[False, True], ids=["flesh", "contact"])
def driven(request):
    block = Driven(request.param)
    q = Q
    x = block.settled(Q, block.x)
    controls = block.controls(q, x)
    contact = curvature(block.potentials, x)
    response = Response.exact(block.flesh, x, block.state(q)[0], contact=contact)
    assert response.minimum
    return block, q, x, controls, response


def test_motions_are_those_of_solved_equilibria(driven):
    block, q, x, controls, response = driven
    if block.potentials:
        assert all(each.value(x) > 1e-6 for each in block.potentials)
    motions = response.motions(controls)
    for k in range(7):
        change = STEP * np.eye(7)[k]
        ends = [block.settled(q + sign * change, x) for sign in (1, -1)]
        expected = (ends[0] - ends[1]) / (2 * STEP)
        if k < 5 or block.potentials:
            assert np.abs(expected).max() > 1e-2
        scale = max(np.abs(expected).max(), 1e-2)
        np.testing.assert_allclose(motions[:, :, k], expected, atol=2e-6 * scale)


def test_products_and_adjoint_agree_with_the_columns(driven):
    block, _, x, controls, response = driven
    rng = np.random.default_rng(3)
    motions = response.motions(controls)
    change = rng.standard_normal(7)
    gradient = rng.standard_normal(x.shape)
    product = response.product(controls, change)
    np.testing.assert_allclose(product, motions @ change, atol=1e-9 * np.abs(product).max())
    assert np.abs(product).max() > 1.0
    free = motions.reshape(x.size, -1)[block.flesh.free_coordinates]
    np.testing.assert_allclose(response.columns(controls), free)
    # <g, J dq> = <J^T g, dq>
    adjoint = response.adjoint(controls, gradient)
    assert (gradient * product).sum() == pytest.approx(adjoint @ change, rel=1e-9)


@pytest.mark.parametrize("name", SOLVERS)
def test_an_indefinite_hessian_is_no_minimum_and_still_answers(name):
    """A straight column under load: the equilibrium has a direction to fall in."""
    rest, tets = grid((2, 2, 16), (4.0, 4.0, 64.0))
    flesh = Flesh(rest, tets, np.flatnonzero((rest[:, 2] == 0.0) | (rest[:, 2] == 64.0)))
    x = rest * [1.0, 1.0, 0.95]
    a = flesh.passive()
    H = flesh.hessian(x, a)
    try:
        linear = analyse(H, name)
    except InputError as error:  # an extra that is not installed
        pytest.skip(str(error))
    assert np.linalg.eigvalsh(H.toarray()).min() < 0.0
    response = Response.exact(flesh, x, a, linear=linear)
    assert not response.minimum
    controls = SparseControls.of(flesh, x, a, sp.eye_array(a.size, 4, format="csr"))
    found = response.columns(controls)
    exact = -np.linalg.solve(H.toarray(), controls.columns())
    assert np.abs(exact).max() > 1e-3
    tolerance = 1e-3 if name == "rslab-single" else 1e-8
    np.testing.assert_allclose(found, exact, atol=tolerance * np.abs(exact).max())
    assert Response.exact(flesh, rest, a, linear=linear).minimum
