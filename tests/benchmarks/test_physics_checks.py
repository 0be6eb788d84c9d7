"""Flesh against closed forms: the checks that the benchmark of the physics reports."""

import pytest

from benchmarks.physics import checks
from benchmarks.plots import power_law
from tests.solver.block import block_model


@pytest.mark.parametrize("material", checks.MATERIALS.values(), ids=checks.MATERIALS)
def test_bars_stretch_and_round_bodies_shrink_as_their_material_says(material):
    width, stress = checks.pulled(material)
    assert 0.85 < width < 0.98
    assert stress > 0.55
    assert checks.stretched(material) < 1e-6
    assert checks.squeezed(material) < 1e-3


def test_errors_fall_with_the_square_of_the_size():
    cells = (3, 6)
    errors = [checks.refinement(count) for count in cells]
    assert power_law([1.0 / count for count in cells], errors)[0] > 1.8


def test_free_flesh_keeps_momentum_and_gains_no_energy():
    figures = checks.flying(block_model())
    assert figures["momentum_drift"] < 1e-9
    assert figures["energy_growth"] == 0.0
    assert figures["energies"][-1] < 0.95
