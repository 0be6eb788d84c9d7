"""Lids of a played face, led to the template's shapes where muscles leave a gap."""

from types import SimpleNamespace

import numpy as np
import pytest

from solver.animation.lids import Lids, PlayedLids
from solver.templates.builtin.build import builtin_template
from tests.fixtures import small_model

BLINK = ("eyeBlinkLeft", "eyeBlinkRight")


@pytest.mark.long
def test_lids_go_as_far_as_their_weights_say() -> None:
    """The left eye blinks; muscles have brought both of its lids two thirds of the way."""
    model = small_model()
    basis = builtin_template().shapes
    assert basis is not None
    names = ("jawOpen", *BLINK)
    shapes = [basis.expressions[basis.expression_names.index(name)] for name in names]
    neutral = model.skin.vertices
    weights = np.zeros(3)
    drives = SimpleNamespace(names=names, weights_at=lambda time: time * weights)
    eyes = Lids.of(model)
    played = PlayedLids(eyes, basis, drives)  # type: ignore[arg-type]
    weights[1] = 1.0
    shut = neutral + shapes[1]
    flesh = neutral + shapes[1] / 1.5
    left, right = eyes

    led = played.lead(flesh, neutral, 1.0)
    lids = left.vertices
    gap = np.linalg.norm(flesh[lids] - shut[lids], axis=1).max()
    assert gap > 1.0
    assert np.linalg.norm(led[lids] - shut[lids], axis=1).max() < 0.2 * gap
    assert left.depth(led).max() < 1e-6
    for still in (right.vertices, np.flatnonzero(left.share == 0.0)):
        np.testing.assert_array_equal(led[still], flesh[still])

    np.testing.assert_array_equal(played.lead(flesh, neutral, 0.0), flesh)
    half = np.abs(played.lead(flesh, neutral, 0.5) - flesh).max()
    little = np.abs(played.lead(flesh, neutral, 0.01) - flesh).max()
    assert 0.0 < little < 0.1 * half
