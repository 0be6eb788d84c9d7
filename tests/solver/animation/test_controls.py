"""Learned controls: the maps, their doubt, the mixtures that they are learned from, and files."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from solver.animation.controls.doubt import Doubt, discrimination
from solver.animation.controls.maps import (
    Leverage,
    Network,
    NetworkOptions,
    PolynomialMap,
    PolynomialOptions,
    ShapeSizes,
    _gradients,
)
from solver.animation.controls.metric import Metric
from solver.animation.controls.mixtures import LEVELS, Mixtures, WalkOptions
from solver.animation.controls.skin import SkinModes
from solver.fitting.activation import rest_curvature
from solver.fitting.face import Face
from solver.scans.live_link import ARKIT_NAMES
from tests.solver.block import head_block

RANDOM = np.random.default_rng(3)
SIZES = ShapeSizes(np.array([2.0, 1.0, 0.5]), np.ones((3, 3)))
WEIGHTS = RANDOM.random((400, 3))


def curved(c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return what a polynomial of the map's kind makes of weights (..., 3)."""
    first, second, third = np.moveaxis(np.asarray(c, float), -1, 0)
    parts = (first - 0.5 * first * second, third + 0.3 * third**3 + 0.2 * second**2)
    return np.stack(parts, axis=-1)


def bent(c: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return what no polynomial of the kind makes: a muscle that stops at its bound."""
    return np.stack([np.minimum(c[..., 0] + c[..., 1], 0.8), c[..., 2]], axis=-1)


def test_a_polynomial_is_found_again() -> None:
    least = PolynomialOptions(1e-12, 1e-12, 1e-12)
    found = PolynomialMap.learn(WEIGHTS, curved(WEIGHTS), SIZES, least)
    fresh = RANDOM.random((50, 3))
    np.testing.assert_allclose(found(fresh), curved(fresh), atol=2e-5)
    assert not found(np.zeros(3)).any()
    again = PolynomialMap.of(found.arrays())
    np.testing.assert_array_equal(again(fresh), found(fresh))


def test_leverage_is_what_a_pair_says_of_itself() -> None:
    """The derivative of a pair's learned coordinate by the one that it was learned from."""
    options = PolynomialOptions(ridge=1e-2, ridge_products=3.0, ridge_cubes=3.0)
    goals = np.zeros((len(WEIGHTS), 1))
    goals[7] = 1.0
    found = PolynomialMap.learn(WEIGHTS, goals, SIZES, options)(WEIGHTS[7])[0]
    leverage = Leverage.of(WEIGHTS, SIZES, options)
    told = leverage(np.array([WEIGHTS[7], np.zeros(3), 3.0 * WEIGHTS[7]]))
    assert found > 1e-3
    assert told[0] == pytest.approx(found, rel=1e-4)
    assert told[1] == 0.0
    assert told[2] > told[0]


def test_shapes_that_move_other_parts_have_no_product() -> None:
    motions = np.zeros((3, 4, 3))
    motions[0, :2, 0] = 2.0
    motions[1, 1:3, 1] = 2.0
    motions[2, 3, 2] = 1.0
    sizes = ShapeSizes.of(motions)
    np.testing.assert_allclose(sizes.alone, [np.sqrt(2.0), np.sqrt(2.0), 0.5])
    products = PolynomialMap.learn(WEIGHTS, curved(WEIGHTS), sizes).products
    assert products.tolist() == [[0, 0], [0, 1], [1, 1], [2, 2]]


def test_the_network_s_gradients_are_those_of_differences() -> None:
    sizes = (3, 5, 4, 2)
    values = []
    for ins, outs in pairwise(sizes):
        values += [RANDOM.normal(size=(ins, outs)), RANDOM.normal(size=outs)]
    inputs = RANDOM.normal(size=(6, 3))
    goals = RANDOM.normal(size=(6, 2))

    def cost() -> float:
        seen = np.vstack([inputs, np.zeros(3)])
        for matrix, shift in zip(values[:-2:2], values[1:-2:2], strict=True):
            seen = np.maximum(seen @ matrix + shift, 0.0)
        outputs = seen @ values[-2]
        return float(0.5 * np.mean((outputs[:-1] - outputs[-1] - goals) ** 2))

    # the last layer's shift goes out again with N(0)
    for value, slope in zip(values[:-1], _gradients(values, inputs, goals)[:-1], strict=True):
        assert np.abs(slope).max() > 1e-3
        for place in np.ndindex(value.shape):
            value[place] += 1e-6
            above = cost()
            value[place] -= 2e-6
            below = cost()
            value[place] += 1e-6
            assert (above - below) / 2e-6 == pytest.approx(slope[place], abs=1e-7)


def test_adam_comes_as_far_as_another_descent_on_the_same_loss() -> None:
    """The oracle: SciPy's L-BFGS on all pairs at once, with a loss and derivatives of its own."""
    width = 32
    effort = NetworkOptions((width,), epochs=1000, rate=0.01, decay=0.01, on_linear=False)
    noise = 0.1 * np.random.default_rng(5).normal(size=(len(WEIGHTS), 2))
    goals = curved(WEIGHTS) + bent(WEIGHTS) + noise
    inputs = WEIGHTS * SIZES.alone / SIZES.alone.mean()
    unit = np.sqrt(np.mean(goals**2))
    places = np.cumsum([3 * width, width])

    def cost(values: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        matrix, shift, last = np.split(values, places)
        matrix, last = matrix.reshape(3, width), last.reshape(width, 2)
        before = inputs @ matrix + shift
        lit = np.maximum(before, 0.0) - np.maximum(shift, 0.0)
        off = lit @ last - goals / unit
        slope = off / off.size
        back = slope @ last.T * (before > 0.0)
        at_rest = slope.sum(axis=0) @ last.T * (shift > 0.0)
        slopes = inputs.T @ back, back.sum(axis=0) - at_rest, lit.T @ slope
        parts = matrix, shift, last
        decayed = [s + effort.decay / p.size * p for s, p in zip(slopes, parts, strict=True)]
        loss = np.mean(off**2) + effort.decay * sum(np.mean(part**2) for part in parts)
        return 0.5 * float(loss), np.concatenate([each.ravel() for each in decayed])

    def descend(begin: NDArray[np.float64]) -> float:
        return float(minimize(cost, begin, jac=True, method="L-BFGS-B").fun)

    (matrix, shift), (last, _) = Network.learn(WEIGHTS, goals, SIZES, 2, effort).layers
    found = np.concatenate([matrix.ravel(), shift, last.ravel() / unit]).astype(float)
    ours = cost(found)[0]
    begins = 0.5 * np.random.default_rng(0).normal(size=(2, len(found)))
    assert ours < 1.05 * min(map(descend, begins))
    assert ours < 1.05 * descend(found)
    off = WEIGHTS @ np.linalg.lstsq(WEIGHTS, goals, rcond=None)[0] - goals
    assert ours < 0.5 * 0.5 * np.mean(off**2) / unit**2  # more than a linear map can


def test_a_network_learns_what_bends() -> None:
    fresh = RANDOM.random((200, 3))
    effort = NetworkOptions(layers=(64,), epochs=400)
    network = Network.learn(WEIGHTS, bent(WEIGHTS), SIZES, 1, effort)
    linear = fresh @ np.linalg.lstsq(WEIGHTS, bent(WEIGHTS), rcond=None)[0]
    off = [np.abs(each - bent(fresh)).mean() for each in (network(fresh), linear)]
    assert off[0] < 0.25 * off[1]
    assert not network(np.zeros(3)).any()
    same = Network.learn(WEIGHTS, bent(WEIGHTS), SIZES, 1, effort)
    np.testing.assert_array_equal(same(fresh), network(fresh))
    np.testing.assert_array_equal(Network.of(network.arrays())(fresh), network(fresh))


def test_doubt_is_found_again_and_covers_most_errors() -> None:
    apart, target = RANDOM.lognormal(-3.0, 0.5, (2, 4000))
    errors = 0.7 * apart**0.8 * target**0.3 * RANDOM.lognormal(0.0, 0.2, 4000)
    doubt = Doubt.calibrate(apart, target, errors, 0.9)
    assert (doubt.apart, doubt.target) == pytest.approx((0.8, 0.3), abs=0.03)
    assert np.mean(errors <= doubt.of(apart, target)) == pytest.approx(0.9, abs=0.01)


def test_discrimination_counts_pairs_in_order() -> None:
    wrong = np.array([False, True, False, True])
    assert discrimination(np.array([0.1, 0.2, 0.3, 0.4]), wrong) == 0.75
    assert discrimination(np.array([0.1, 0.3, 0.2, 0.4]), wrong) == 1.0
    assert discrimination(np.ones(4), np.zeros(4, bool)) is None


def test_mixtures_are_possible() -> None:
    mixtures = Mixtures(tuple(ARKIT_NAMES[:51]))
    place = {name: number for number, name in enumerate(mixtures.names)}
    random = np.random.default_rng(0)
    drawn = np.array([mixtures.draw(random) for _ in range(400)])
    assert drawn.min() == 0.0
    assert 0.9 < drawn.max() <= 1.0
    assert (drawn[:, place["mouthClose"]] <= drawn[:, place["jawOpen"]]).all()
    assert (drawn > 0.0).any(axis=0).all()
    assert not drawn.any(axis=1).all()  # rest is among them
    units = mixtures.of_units(mixtures.draw_units(random, 3))
    assert (units > 0.0).sum() >= 2
    for name, number in place.items():
        if name.endswith("Left") and name.startswith(("brow", "cheek", "mouthSmile")):
            assert units[number] == units[place[name.removesuffix("Left") + "Right"]]


def test_every_shape_is_alone_at_every_level() -> None:
    alone = np.array(Mixtures(("jawOpen", "mouthClose"), WalkOptions()).alone())
    levels = np.array(LEVELS)
    np.testing.assert_array_equal(alone[:4], np.stack([levels, 0.0 * levels], axis=1))
    np.testing.assert_array_equal(alone[4:], np.stack([levels, levels], axis=1))


def test_the_metric_is_the_skin_s_motion_at_rest() -> None:
    face = Face(head_block((5, 4, 1)))
    metric = Metric.of_face(face, unseen=1e-9)
    change = 0.01 * RANDOM.standard_normal(len(metric.root))
    assert np.sum((change @ metric.root) ** 2) == pytest.approx(
        0.5 * change @ rest_curvature(face) @ change, rel=1e-4
    )
    changes = RANDOM.standard_normal((20, 4)) @ RANDOM.standard_normal((4, len(change)))
    main = metric.main_directions(changes, 8)
    assert main.coordinates.shape == (20, 4)
    np.testing.assert_allclose(main.coordinates @ main.directions, changes, atol=1e-4)


def test_modes_give_back_a_skin() -> None:
    rest = RANDOM.standard_normal((30, 3))
    skins = rest + np.einsum("nm,mvi->nvi", RANDOM.random((9, 2)), RANDOM.random((2, 30, 3)))
    modes = SkinModes.of(rest, skins, 5)
    reduced = np.array([modes.reduce(skin) for skin in skins])
    assert reduced.shape == (9, 2)
    np.testing.assert_allclose(modes.expand(reduced), skins, atol=1e-5)
    moved = np.sqrt(np.mean(np.sum((skins - rest) ** 2, axis=2), axis=1))
    np.testing.assert_allclose(np.linalg.norm(reduced, axis=1), moved, rtol=1e-5)
