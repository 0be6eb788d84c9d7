"""``rig.glb`` and the Khronos validator (``npm install gltf-validator``, on NODE_PATH)."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.rig.gltf import write_glb
from solver.rig.result import ExpressionFit, Rig
from tests.fixtures import fixture_model, ict_capture

SCRIPT = """
require('gltf-validator')
  .validateBytes(new Uint8Array(require('fs').readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report.issues)))
"""


@pytest.mark.parametrize("names", [["smile", "surprise", "neutral"], []])
def test_no_errors_and_no_warnings(names: list[str], tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None or subprocess.run([node, "-e", "require('gltf-validator')"]).returncode != 0:
        pytest.skip("node with the package gltf-validator is not installed")
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
    write_glb(path, Rig(model, model.weights, tuple(fits), {}))
    command = [node, "-e", SCRIPT, str(path)]
    issues = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]
