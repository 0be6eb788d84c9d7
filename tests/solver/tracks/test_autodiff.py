"""Faces under tracks as functions that JAX and PyTorch differentiate."""

import warnings

import numpy as np
import pytest

from solver.errors import InputError, SolveError
from solver.tracks.autodiff import SkinMap, jax_function, torch_function
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace
from solver.tracks.response import TrackResponse
from tests.fixtures import jax_module
from tests.solver.tracks.block import block_shapes, tracked_block

EXACT = {"stiffness_pa": 1.0, "tolerance": 1e-12, "settled_mm": 0.0}
JAW = np.array([0.02, 0.01, 0.2, -0.1, 0.1])


@pytest.fixture(scope="module")
def face():
    model = tracked_block()
    return TrackFace(model, MuscleTracks.of(model, block_shapes(model)), **EXACT)


@pytest.fixture(scope="module")
def q(face):
    return face.tracks.controls({"aside": 0.7, "bulge": 0.4, "open": 0.3}, JAW)


@pytest.fixture(scope="module")
def columns(face, q):
    return TrackResponse(face, face.move(face.rest(), q)).skin_columns()


@pytest.fixture(scope="module")
def jax():
    jax = jax_module()
    jax.config.update("jax_enable_x64", True)
    return jax


def test_derivatives_are_of_the_state_whose_skin_was_returned(face, q, columns):
    skin_map = SkinMap(face, kept=1)
    state = skin_map.state(q)
    others = [skin_map.state(part * q) for part in (0.9, 0.5)]
    assert not np.allclose(others[0].x, state.x)
    change = np.random.default_rng(1).standard_normal(face.tracks.size)
    moved = skin_map.product(state.q, state.x, change)
    np.testing.assert_allclose(moved, columns @ change, atol=1e-7 * np.abs(moved).max())
    pulled = skin_map.adjoint(state.q, state.x, moved)
    np.testing.assert_allclose(pulled, np.einsum("vik,vi->k", columns, moved), rtol=1e-6)


def test_what_is_kept_is_not_solved_for_again(face, q):
    skin_map = SkinMap(face, kept=2)
    first = skin_map.state(q)
    second = skin_map.state(0.9 * q)
    assert skin_map.state(q.copy()) is first
    skin_map.state(0.8 * q)
    assert skin_map.state(0.9 * q) is second
    assert skin_map.state(q) is not first


def test_evaluations_begin_where_they_are_told_to(face, q):
    start = face.move(face.rest(), q)
    assert SkinMap(face, start).state(q) is start


def test_a_place_that_is_no_equilibrium_has_no_derivative(face, q):
    skin_map = SkinMap(face)
    state = skin_map.state(q)
    aside = state.x + 0.1 * np.sin(np.arange(state.x.size)).reshape(-1, 3)
    with pytest.raises(SolveError) as error:
        skin_map.product(q, aside, q)
    assert error.value.code == "tracks.no_equilibrium"


def test_flesh_about_to_buckle_is_told(face, q, monkeypatch):
    monkeypatch.setattr(TrackResponse, "minimum", False)
    skin_map = SkinMap(face)
    state = skin_map.state(q)
    with pytest.warns(RuntimeWarning, match="about to buckle"):
        skin_map.product(q, state.x, q)
    with warnings.catch_warnings(action="error"):
        skin_map.product(q, state.x, q)  # the same state


@pytest.mark.parametrize(
    ("function", "package"), [(jax_function, "jax"), (torch_function, "torch")]
)
def test_a_framework_that_is_missing_is_named(face, function, package, monkeypatch):
    monkeypatch.setattr("solver.tracks.autodiff.find_spec", lambda _: None)
    with pytest.raises(InputError, match="not installed") as error:
        function(face)
    assert error.value.code == "tracks.extra"
    assert error.value.context == {"package": package}


def test_another_mode_is_named(face):
    with pytest.raises(InputError, match="reverse, forward") as error:
        jax_function(face, "both")
    assert error.value.code == "tracks.options"


@pytest.mark.long
@pytest.mark.parametrize(("mode", "checked"), [("reverse", "rev"), ("forward", "fwd")])
def test_jax_checks_the_gradients(jax, face, q, mode, checked):
    from jax.test_util import check_grads

    function = jax_function(face, mode)
    check_grads(function, (jax.numpy.array(q),), order=1, modes=[checked], rtol=1e-6, atol=1e-6)


@pytest.mark.long
def test_jax_has_values_and_all_derivatives(jax, face, q, columns):
    state = face.move(face.rest(), q)
    reverse = jax_function(face, "reverse")
    forward = jax_function(face, "forward")
    size = np.abs(columns).max()
    for function in (reverse, jax.jit(reverse), forward, jax.jit(forward)):
        np.testing.assert_allclose(function(q), face.skin(state), atol=1e-8)
    for found in (jax.jacrev(lambda q: reverse(q)[:2])(q), jax.jacfwd(forward)(q)[:2]):
        np.testing.assert_allclose(found, columns[:2], atol=1e-8 * size)


@pytest.mark.long
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_jax_batches_states(jax, face, q, mode):
    numpy = jax.numpy
    function = jax_function(face, mode)
    batch = numpy.stack([q, 0.5 * q, 0.8 * q])
    alone = numpy.stack([function(each) for each in batch])
    for together in (function(batch), jax.vmap(function)(batch), jax.jit(function)(batch)):
        assert together.shape == (3, *alone.shape[1:])
        np.testing.assert_allclose(together, alone, atol=1e-8)
    assert function(batch[None]).shape == (1, *alone.shape)

    def height(q):
        return (function(q) ** 2).sum()

    derive = jax.grad if mode == "reverse" else jax.jacfwd
    found = jax.jit(jax.vmap(derive(height)))(batch)
    for each, expected in zip(found, [derive(height)(each) for each in batch], strict=True):
        np.testing.assert_allclose(each, expected, rtol=1e-6)
    np.testing.assert_allclose(derive(lambda batch: height(batch))(batch), found, rtol=1e-6)


@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_jax_does_not_nest_derivatives(jax, face, q, mode):
    function = jax_function(face, mode)
    derive = {"reverse": jax.grad, "forward": jax.jacfwd}[mode]

    def first(q):
        return derive(lambda q: (function(q) ** 2).sum())(q).sum()

    for nested in (derive(first), jax.jit(derive(first)), jax.jacfwd(first)):
        with pytest.raises(InputError, match="first derivatives only") as error:
            nested(q)
        assert error.value.code == "tracks.second_derivative"


@pytest.mark.long
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_jax_in_single_precision_is_told_once(jax, face, q, columns, mode):
    function = jax_function(face, mode)
    single = jax.numpy.asarray(q, jax.numpy.float32)
    with pytest.warns(UserWarning, match="double precision.*jax_enable_x64"):
        found = function(single)
    assert found.dtype == np.float32
    with warnings.catch_warnings(action="error"):
        again = function(single)
        derive = jax.jacrev if mode == "reverse" else jax.jacfwd
        rates = derive(lambda q: function(q)[5])(single)
    np.testing.assert_array_equal(again, found)
    np.testing.assert_allclose(rates, columns[5], atol=1e-5 * np.abs(columns).max())


def test_jax_without_double_precision_differentiates_the_state_itself(jax, face, q, columns):
    jax.config.update("jax_enable_x64", False)
    try:
        with pytest.warns(UserWarning, match="double precision"):
            rates = jax.jit(jax.jacfwd(jax_function(face, "forward")))(q)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert rates.dtype == np.float32
    np.testing.assert_allclose(rates, columns, atol=1e-5 * np.abs(columns).max())


def test_jax_takes_controls_only(jax, face, q):
    function = jax_function(face)
    for wrong in (q[:-1], np.float64(1.0), np.stack([q[1:]] * 2)):
        with pytest.raises(InputError) as error:
            function(wrong)
        assert error.value.code == "tracks.controls"


def test_jax_hands_errors_on_with_their_code(jax, face, q):
    function = jax_function(face)
    for each in (function, jax.jit(function)):
        with pytest.raises(jax.errors.JaxRuntimeError, match=r"tracks\.controls: .* all finite"):
            jax.block_until_ready(each(np.nan * q))


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch", reason="PyTorch is not installed")


@pytest.mark.long
def test_torch_checks_the_gradients(torch, face, q):
    given = torch.from_numpy(q).requires_grad_()
    check = {"eps": 1e-4, "atol": 1e-5, "check_forward_ad": True, "nondet_tol": 1e-9}
    assert torch.autograd.gradcheck(torch_function(face), given, **check)


def test_torch_batches_states(torch, face, q, columns):
    function = torch_function(face)
    batch = torch.from_numpy(np.stack([q, 0.5 * q])).requires_grad_()
    skins = function(batch)
    assert skins.shape == (2, len(columns), 3)
    (found,) = torch.autograd.grad((skins**2).sum(), batch)
    expected = 2.0 * np.einsum("vik,vi->k", columns, skins[0].detach())
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


def test_torch_does_not_nest_derivatives(torch, face, q):
    given = torch.from_numpy(q).requires_grad_()
    skin = torch_function(face)(given)
    (first,) = torch.autograd.grad((skin**2).sum(), given, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        first.sum().backward()


def test_torch_in_single_precision_is_told_once(torch, face, q):
    function = torch_function(face)
    single = torch.from_numpy(q.astype(np.float32))
    with pytest.warns(UserWarning, match="double precision.*float64"):
        assert function(single).dtype == torch.float32
    with warnings.catch_warnings(action="error"):
        function(single)
