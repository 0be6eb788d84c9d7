"""``rig.glb``, ``animation.glb`` and the Khronos validator."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from myoface.demo.outcome import khronos_validation
from solver.cache import cache_directory
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import glb
from solver.rig.frames.animation_gltf import write_animation_glb
from solver.rig.frames.gltf import Solid
from solver.surface import Surface
from tests.fixtures import fixture_model, ict_capture

BOX = trimesh.creation.box([80.0, 60.0, 2.0])


@pytest.mark.parametrize("names", [["smile", "surprise", "neutral"], []])
def test_no_errors_and_no_warnings(names: list[str], tmp_path: Path) -> None:
    model = replace(fixture_model("neutral_coarse"), skin=ict_capture("neutral"))
    fits = []
    for name in names:
        skin = ict_capture(name).vertices
        error = np.full(len(skin), np.nan)
        error[model.face] = 0.5
        still = np.zeros((model.muscle_count, 6))
        fit = ExpressionFit(name, "train", still, np.zeros(5), skin, skin, error, 0, 1, 0.1, 0.0)
        fits.append(fit)
    path = tmp_path / "rig.glb"
    glb.write(Rig(model, model.weights, tuple(fits), {}), path)
    check(path)


def test_nor_any_of_an_animation(tmp_path: Path) -> None:
    neutral = ict_capture("neutral")
    away = ict_capture("smile").vertices - neutral.vertices
    times = np.arange(12) / 30.0
    skins = np.array([neutral.vertices + np.sin(5.0 * time) * away for time in times], np.float32)
    heads = np.zeros((12, 6))
    heads[:, 1] = 0.4 * np.sin(times)
    path = tmp_path / "animation.glb"
    turning = np.zeros((12, 6))
    turning[:, 2] = 3.0 * times
    turning[:, 5] = 150.0
    pane = Surface(*(np.asarray(each) for each in (BOX.vertices, BOX.faces)))
    solids = [
        Solid("glass", pane, turning),
        Solid("Wand \u2713", pane, np.tile(turning[3], (12, 1))),
    ]
    write_animation_glb(path, neutral, skins, heads, times, solids)
    check(path)


def check(path: Path) -> None:
    """Let the validator say that all is well, without a word."""
    found = khronos_validation(path, cache_directory() / "gltf-validator")
    if found.errors is None:
        pytest.skip(found.note)
    assert (found.errors, found.warnings) == (0, 0), found.note
