"""Threads of the fibres picture, on a block of flesh."""

from dataclasses import replace

import numpy as np

from solver.rig.pictures import ThreadOptions, fibre_threads
from tests.solver.block import block_model


def test_threads_run_along_the_fibres_inside_their_muscle():
    model = block_model()
    options = ThreadOptions()
    entries = model.weights.tocoo()
    fibres = np.zeros((model.weights.nnz, 3))
    fibres[entries.col == 1] = [0, 1, 0]
    fibres[entries.col == 2] = [1, 0, 0]
    threads = fibre_threads(replace(model, fibres=fibres))
    assert set(threads) == {"left", "right"}
    for name, axis in (("left", 1), ("right", 0)):
        lines = threads[name].vertices.reshape(-1, 2 * options.steps + 1, 3, 3)
        length = np.ptp(lines.mean(axis=2), axis=1)
        np.testing.assert_allclose(length[:, axis], 2 * options.steps * options.step_mm, atol=1e-9)
        assert np.abs(np.delete(length, axis, axis=1)).max() < 1e-9
    centre = threads["left"].vertices[:, 0]
    assert centre.max() < threads["right"].vertices[:, 0].max()


def test_a_model_without_fibres_has_no_threads():
    assert fibre_threads(block_model()) == {}
