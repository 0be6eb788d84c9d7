"""The mesh-wide energy against finite differences, a linear patch and a known answer."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial import KDTree

from solver.errors import InputError, SolveError
from solver.mechanics import equilibrium, linear
from solver.mechanics.flesh import (
    COROTATED_DET,
    COROTATED_TRACE,
    MOONEY_RIVLIN,
    NEO_HOOKEAN,
    Flesh,
    Material,
)
from tests.fixtures import FELUPE_FILE
from tests.solver.block import block_model, grid

MATERIALS = {
    "trace": COROTATED_TRACE,
    "det": COROTATED_DET,
    "neo_hookean": NEO_HOOKEAN,
    "mooney_rivlin": MOONEY_RIVLIN,
    "pascal": NEO_HOOKEAN.in_pascal(2.5),
}


@pytest.fixture(scope="module", params=MATERIALS.values(), ids=MATERIALS)
def strained(request):
    """Flesh far from rest: random activations that commute with nothing, a few tets nearly flat.

    Each tet has a stiffness and a growth of its own.
    """
    model = block_model()
    rng = np.random.default_rng(5)
    stiffness = rng.uniform(0.5, 2.0, len(model.tets))
    growth = rng.uniform(0.9, 1.1, len(model.tets))
    flesh = Flesh(
        model.rest,
        model.tets,
        model.cranium,
        request.param,
        stiffness_factor=stiffness,
        growth=growth,
    )
    x = model.rest.copy()
    x[flesh.free] += 1.2 * rng.standard_normal((len(flesh.free), 3))
    a = flesh.passive() + 0.15 * rng.standard_normal((len(model.tets), 6))
    assert flesh.jacobians(x).min() < 0.35
    assert np.isfinite(flesh.energy(x, a))
    return flesh, x, a, rng.standard_normal((len(flesh.free), 3))


def moved(flesh, x, direction, step):
    y = x.copy()
    y[flesh.free] += step * direction
    return y


def test_gradient_matches_finite_differences(strained):
    flesh, x, a, direction = strained
    h = 1e-6
    ends = [flesh.energy(moved(flesh, x, direction, sign * h), a) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * h)
    assert abs(numeric) > 1.0
    assert flesh.gradient(x, a) @ direction.ravel() == pytest.approx(numeric, rel=2e-6)


def test_hessian_matches_finite_differences_and_is_symmetric(strained):
    flesh, x, a, direction = strained
    h = 1e-6
    ends = [flesh.gradient(moved(flesh, x, direction, sign * h), a) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * h)
    H = flesh.hessian(x, a)
    assert np.abs(numeric).max() > 1.0
    np.testing.assert_allclose(H @ direction.ravel(), numeric, atol=1e-6 * np.abs(numeric).max())
    assert abs(H - H.T).max() < 1e-10 * abs(H).max()


def test_projected_hessian_is_positive_semidefinite_where_the_raw_one_is_not(strained):
    flesh, x, a, _ = strained
    lowest = [
        np.linalg.eigvalsh(flesh.hessian(x, a, project=share).toarray()).min() for share in (0, 1)
    ]
    assert lowest[0] < -1.0
    assert lowest[1] > -1e-9


@pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS)
def test_all_laws_are_the_same_flesh_at_small_strain(material):
    """The energy is Lame's mu |e|^2 + lambda/2 tr(e)^2, without stress or energy at rest."""
    vertices, tets = grid((1, 1, 1), (10.0, 10.0, 10.0))
    flesh = Flesh(vertices, tets, np.zeros(0, int), material)
    a = flesh.passive()
    assert flesh.energy(vertices, a) == pytest.approx(0.0, abs=1e-10)
    assert np.abs(flesh.gradient(vertices, a)).max() < 1e-11
    strain = np.array([[3.0, 1.0, -2.0], [1.0, -1.0, 0.5], [-2.0, 0.5, 2.0]])
    spin = np.array([[0.0, -1.0, 2.0], [1.0, 0.0, 0.5], [-2.0, -0.5, 0.0]])
    mu = material.mu
    lam = material.lam + 2.0 * material.kappa
    density = mu * (strain**2).sum() + 0.5 * lam * np.trace(strain) ** 2
    motion = (vertices @ (strain + spin).T).ravel()
    half = 0.5 * motion @ (flesh.hessian(vertices, a) @ motion)
    assert half == pytest.approx(1000.0 * density, rel=1e-9)


@pytest.mark.parametrize("stretch", [0.7, 0.9, 1.1, 1.4, 1.8])
def test_a_bar_of_mooney_rivlin_flesh_pulls_as_its_closed_form(stretch):
    """Only its ends are held: the width and the force are Holzapfel's (2000, eq. 6.89 to 6.108).

    s1 - s2 = 2/J (l1^2 - l2^2)(c1 + c2 l2^2) of the stretches without change of volume, s2 = 0, and
    (s1 + 2 s2) / 3 = U'(J).
    """
    material = MOONEY_RIVLIN.in_pascal(3000.0)
    c = material.mu / 4.0
    bulk = 2.0 * material.kappa + (material.lam + 2.0 / 3.0 * material.mu)

    def pull(width):
        J = stretch * width**2
        long, wide = (each * J ** (-1.0 / 3.0) for each in (stretch, width))
        return 2.0 / J * (long**2 - wide**2) * (c + c * wide**2), bulk * (J - 1.0)

    width = brentq(lambda w: pull(w)[0] - 3.0 * pull(w)[1], 0.5, 1.5, xtol=1e-15)
    assert abs(width - stretch**-0.5) < 0.05
    vertices, tets = grid((6, 2, 2), (30.0, 10.0, 10.0))
    ends = [vertices[:, 0] == 0.0, vertices[:, 0] == 30.0]
    flesh = Flesh(vertices, tets, np.flatnonzero(ends[0] | ends[1]), material)
    x = vertices * [stretch, width, width]
    start = x.copy()
    a = flesh.passive()
    start[flesh.free] += 0.3 * np.random.default_rng(4).standard_normal((len(flesh.free), 3))
    solver = linear.analyse(flesh.hessian(vertices, a))
    found = equilibrium.solve_equilibrium(flesh, solver, start, a, tolerance=1e-13).x
    np.testing.assert_allclose(found, x, atol=1e-8)
    free = Flesh(vertices, tets, np.zeros(0, int), material)
    force = free.gradient(found, a).reshape(-1, 3)[ends[1]].sum(axis=0)
    pulled = pull(width)[0] * (10.0 * width) ** 2
    assert abs(pulled) > 1e4
    np.testing.assert_allclose(force, [pulled, 0.0, 0.0], atol=1e-6 * abs(pulled))


@pytest.mark.parametrize("case", range(4))
def test_a_clamped_bar_of_mooney_rivlin_flesh_is_that_of_felupe(case):
    """Twisted, stretched, sheared, pressed and bent, up to next to incompressible."""
    with np.load(FELUPE_FILE) as found:
        vertices = found["vertices"]
        tets = found["tets"]
        bulk = found["bulk"][case]
        mu = float(found["mu"])
        places = found["places"][case]
        forces = found["forces"][case]
    # Lame's lambda at small strain
    material = Material(mu, lam=bulk - 2.0 / 3.0 * mu, barrier_weight=mu, law="mooney_rivlin")
    ends = np.isin(vertices[:, 0], [0.0, 30.0])
    flesh = Flesh(vertices, tets, np.flatnonzero(ends), material)
    start = vertices + 0.0
    a = flesh.passive()
    # the ends' motion is even along the bar at the start
    far = vertices[:, 0] == 30.0
    part = vertices[:, :1] / 30.0
    near = KDTree(vertices[far, 1:]).query(vertices[:, 1:])[1]
    start += part * (places - vertices)[far][near]
    start[ends] = places[ends]
    solver = linear.analyse(flesh.hessian(vertices, a))
    x = equilibrium.solve_equilibrium(flesh, solver, start, a, tolerance=1e-13).x
    assert np.abs(x - start).max() > 0.5
    np.testing.assert_allclose(x, places, atol=1e-8)
    free = Flesh(vertices, tets, np.zeros(0, int), material)
    pulls = free.gradient(x, a).reshape(-1, 3)
    np.testing.assert_allclose(pulls, forces, atol=1e-8 * np.abs(forces).max())


@pytest.mark.parametrize("material", [COROTATED_DET, NEO_HOOKEAN, MOONEY_RIVLIN])
def test_grown_and_active_flesh_comes_to_rest_where_both_lead(material):
    """F = S(a) F_p on every tet: without energy, and found from far away."""
    vertices, tets = grid((2, 2, 2), (10.0, 10.0, 10.0))
    growth = np.full(len(tets), 1.2)
    flesh = Flesh(vertices, tets, np.array([0]), material, growth=growth)
    A = np.array([[0.8, 0.1, 0.0], [0.1, 1.1, -0.05], [0.0, -0.05, 1.05]])
    a = np.tile(A[np.triu_indices(3)], (len(tets), 1))
    x = 1.2 * vertices @ A
    assert flesh.energy(vertices, a) > 100.0
    assert flesh.energy(x, a) == pytest.approx(0.0, abs=1e-9)
    assert np.abs(flesh.gradient(x, a)).max() < 1e-9
    np.testing.assert_allclose(flesh.jacobians(x), np.linalg.det(A), rtol=1e-12)


@pytest.mark.parametrize("material", MATERIALS.values(), ids=MATERIALS)
def test_forces_by_activation_match_finite_differences(material):
    model = block_model()
    rng = np.random.default_rng(6)
    flesh = Flesh(model.rest, model.tets, model.cranium, material)
    x = model.rest + 0.5 * rng.standard_normal(model.rest.shape)
    a = flesh.passive() + 0.1 * rng.standard_normal((len(model.tets), 6))
    change = rng.standard_normal(a.shape)
    exact = flesh.scatter(
        np.einsum("evdq,eq->evd", flesh.elastic.forces_by_activation(x, a), change)
    )
    h = 1e-6
    ends = [flesh.gradient(x, a + sign * h * change) for sign in (1, -1)]
    numeric = (ends[0] - ends[1]) / (2 * h)
    assert np.abs(numeric).max() > 1.0
    np.testing.assert_allclose(exact, numeric, atol=1e-6 * np.abs(numeric).max())


def test_neo_hookean_flesh_refuses_activations_that_turn_it_inside_out():
    model = block_model()
    flesh = Flesh(model.rest, model.tets, model.cranium, NEO_HOOKEAN)
    a = flesh.passive()
    a[7, 0] = -0.1
    with pytest.raises(InputError, match="tet number 7") as caught:
        flesh.gradient(model.rest, a)
    assert caught.value.code == "material.activation"


def test_linear_displacements_are_solved_exactly():
    """The patch test: held at a linear displacement on the boundary, the inside follows it."""
    vertices, tets = grid((4, 4, 4), (20.0, 20.0, 20.0))
    outside = ((vertices == 0.0) | (vertices == 20.0)).any(axis=1)
    flesh = Flesh(vertices, tets, np.flatnonzero(outside))
    F = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.1], [0.0, 0.2, 1.05]])
    x = vertices @ F.T
    start = x.copy()
    start[flesh.free] += 0.3 * np.random.default_rng(2).standard_normal((len(flesh.free), 3))
    a = flesh.passive()
    solver = linear.analyse(flesh.hessian(vertices, a))
    result = equilibrium.solve_equilibrium(flesh, solver, start, a)
    np.testing.assert_allclose(result.x, x, atol=1e-7)


def test_free_flesh_takes_the_shape_of_its_activation():
    """Three held corners leave a uniformly active block free to become S(a): zero energy left."""
    vertices, tets = grid((3, 3, 3), (15.0, 15.0, 15.0))
    stretch = np.diag([0.8, 1.1, 1.15])
    held = np.flatnonzero((vertices == 0.0).all(axis=1))
    corner = np.flatnonzero((vertices == [15.0, 0.0, 0.0]).all(axis=1))
    third = np.flatnonzero((vertices == [0.0, 15.0, 0.0]).all(axis=1))
    held = np.concatenate([held, corner, third])
    flesh = Flesh(vertices, tets, held, Material(lam=0.0))
    start = vertices.copy()
    start[held] = vertices[held] @ stretch
    a = np.tile(stretch[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]], (len(tets), 1))
    solver = linear.analyse(flesh.hessian(vertices, a))
    result = equilibrium.solve_equilibrium(flesh, solver, start, a)
    np.testing.assert_allclose(result.x, vertices @ stretch, atol=1e-6)
    assert result.minimum


def test_newton_converges_quadratically():
    model = block_model()
    flesh = Flesh(model.rest, model.tets, np.concatenate([model.cranium, model.mandible]))
    rng = np.random.default_rng(0)
    a = flesh.passive() + 0.15 * rng.standard_normal((len(model.tets), 6))
    solver = linear.analyse(flesh.hessian(model.rest, a))
    result = equilibrium.solve_equilibrium(flesh, solver, model.rest, a, tolerance=1e-12)
    assert result.residual <= 1e-12
    assert result.iterations <= 8


def test_inverted_starts_and_meshes_are_named():
    vertices, tets = grid((2, 2, 2), (10.0, 10.0, 10.0))
    wrong = tets.copy()
    wrong[5] = wrong[5][[1, 0, 2, 3]]
    with pytest.raises(InputError, match="number 5"):
        Flesh(vertices, wrong, np.array([0]))
    flesh = Flesh(vertices, tets, np.array([0]))
    solver = linear.analyse(flesh.hessian(vertices, flesh.passive()))
    with pytest.raises(SolveError) as caught:
        equilibrium.solve_equilibrium(flesh, solver, vertices * [1.0, 1.0, -1.0], flesh.passive())
    assert caught.value.code == "solve.inverted"
