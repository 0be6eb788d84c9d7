"""Single muscles: an end that is held stays, the other one comes, and the sheet shows it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.muscle_sheet import MuscleSheetOptions, draw, least_stretches
from benchmarks.single_muscles import PullOptions, measure, pull_each
from solver.fitting.face import Face
from tests.solver.block import head_block


def test_the_loose_end_comes_to_the_held_one(tmp_path: Path) -> None:
    block = head_block((7, 5, 1))
    held = block.rest[:, 0] < block.rest[:, 0].min() + 1e-6
    along = np.tile([1.0, 0.0, 0.0], (len(block.weights.data), 1))
    model = replace(block, cranium=np.flatnonzero(held), mandible=np.zeros(0, int), fibres=along)
    face = Face(model)
    pulled = dict(pull_each(face, ["left", "right"]))
    assert set(pulled) == {"left", "right"}
    wide = PullOptions(over_mm=40.0)  # the block's skin is coarse
    figures = {name: measure(face, name, each, wide) for name, each in pulled.items()}
    near = min(figures, key=lambda name: figures[name]["held_mm"])
    found = figures[near]
    assert found["insertion_mm"] > 2.0 * abs(found["origin_mm"])
    assert found["pull_mm"] > 0.0
    assert found["fibres"] < 0.97
    # fibres the other way round: the same motion is the origin's
    turned = Face(replace(model, fibres=-along))
    back = measure(turned, near, pulled[near], wide)
    assert np.isclose(back["origin_mm"], found["insertion_mm"], rtol=0.05)
    size = MuscleSheetOptions(smooth_mm=25.0)
    stretch, lines = least_stretches(model, pulled[near], size)
    shortest = np.nanargmin(stretch)
    assert stretch[shortest] < 0.97
    assert abs(lines[shortest, 0]) < 0.2  # folds lie square to the fibres
    draw(tmp_path / "sheet.png", "Block", model, pulled, size)
    assert Image.open(tmp_path / "sheet.png").width == size.columns * size.cell[0]
