"""Laws of muscles, and the bounded least squares that share out their pulls."""

import numpy as np
import pytest

from solver.neck.builtin import builtin_neck
from solver.neck.hill import LAWS, HillOptions, Muscles

NECK = builtin_neck()
REST = np.array([each.length for each in NECK.muscles]) * 1e-3
FIBRES = np.array([each.fibre for each in NECK.muscles]) * 1e-3


@pytest.mark.parametrize("law", LAWS)
def test_derivatives_are_those_of_the_forces(law):
    muscles = Muscles.of(NECK, HillOptions(law=law))
    random = np.random.default_rng(0)
    lengths = REST + FIBRES * random.uniform(-0.3, 0.5, len(REST))
    rates = FIBRES * random.uniform(-5.0, 5.0, len(REST))
    parts = muscles.parts(lengths, rates)
    step = 1e-7
    by_length = (muscles.parts(lengths + step, rates) - muscles.parts(lengths - step, rates)) / (
        2 * step
    )
    by_rate = (muscles.parts(lengths, rates + step) - muscles.parts(lengths, rates - step)) / (
        2 * step
    )
    for column, moved in ((1, by_length[:, 0]), (2, by_rate[:, 0]), (4, by_length[:, 3])):
        size = np.abs(moved).max()
        assert size > 1.0  # there is something to compare
        assert np.abs(parts[:, column] - moved).max() < 1e-6 * size


@pytest.mark.parametrize("law", LAWS)
def test_both_laws_have_the_same_shape(law):
    muscles = Muscles.of(NECK, HillOptions(law=law))
    still = np.zeros(len(REST))
    strengths = np.array([each.strength for each in NECK.muscles])
    at_rest = muscles.parts(REST, still)
    np.testing.assert_allclose(at_rest[:, 0], strengths, rtol=0.05)  # F_0 at rest
    assert (muscles.parts(REST - FIBRES, still)[:, 0] < 0.05 * strengths).all()  # too short
    assert (muscles.parts(REST, -11.0 * FIBRES)[:, 0] == 0.0).all()  # too fast
    assert (muscles.parts(REST, -3.0 * FIBRES)[:, 0] < at_rest[:, 0]).all()
    stretched = muscles.parts(REST + 0.6 * FIBRES, still)[:, 3]
    np.testing.assert_allclose(stretched, strengths, rtol=0.25)  # the passive pull
    assert (at_rest[:, 3] < 0.01 * strengths).all()
