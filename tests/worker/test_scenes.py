"""Jobs with scenes, as the solver process does them: files by role, assets by name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.animation.blendshapes import Blendshapes, Solved
from solver.fitting.face import Pose
from solver.mechanics.flesh import IDENTITY
from solver.progress import silent
from solver.rig import Rig
from solver.rig.frames import SequenceFrame, write_sequence
from solver.scans.live_link import ARKIT_NAMES
from tests.solver.block import head_block
from worker.solve import solve

MODEL = head_block((7, 5, 1))
SOFT = {"edits": [{"kind": "stiffness", "factor": 0.5, "map": {"asset": "soft"}}]}
TAKE = {"recording": {"asset": "take"}}
PERFORMED = {"fps": 10, "performance": {"asset": "sequence"}}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Role, or the name of an asset -> file."""
    folder = tmp_path_factory.mktemp("files")
    names = ("rig", "soft", "take", "blendshapes", "sequence")
    files = {name: folder / name for name in names}
    files = {**files, "soft": folder / "map.npy", "take": folder / "take.csv"}
    Rig(MODEL, MODEL.weights, ()).save(files["rig"])
    np.save(files["soft"], np.ones(len(MODEL.skin.vertices)))
    rows = [["Timecode", *ARKIT_NAMES], ["00:00:00:00", *(["0"] * len(ARKIT_NAMES))]]
    files["take"].write_text("\n".join(map(",".join, rows)))
    a = np.tile(IDENTITY, (2, 1))
    still = (np.zeros(5), np.zeros(6))
    fitted = [SequenceFrame(n, a, *still, 0, 1, 0.1, "fitted", 0, 0, 0, 1) for n in range(4)]
    files["sequence"], *_ = write_sequence(folder, fitted, MODEL.muscle_names, 30.0, {})
    smile = Solved(Pose(np.tile(IDENTITY, (2, 1)), np.zeros(5)), 0.0)
    shapes = Blendshapes(MODEL.muscle_names, {"mouthSmileLeft": smile})
    shapes.save(files["blendshapes"], MODEL, MODEL.weights)
    return files


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "scene", "roles", "told"),
    [
        ("simulate", SOFT, ["soft"], "frames"),
        ("simulate", PERFORMED, ["sequence"], "performances"),
        ("animate", TAKE, ["take", "blendshapes"], "blendshapes"),
        ("edit", SOFT, ["soft"], "volume"),
    ],
)
def test_a_scene_gets_its_person_and_its_assets(
    inputs: dict[str, Path],
    tmp_path: Path,
    kind: str,
    scene: dict[str, Any],
    roles: list[str],
    told: str,
) -> None:
    items = [
        {
            "role": "asset" if name in ("soft", "take", "sequence") else name,
            "name": name,
            "path": str(path),
        }
        for name, path in inputs.items()
        if name in ("rig", *roles)
    ]
    job = {"kind": kind, "inputs": items, "options": {"scene": scene}, "resume": False}
    (tmp_path / "out").mkdir()
    (tmp_path / "job.json").write_text(json.dumps(job))
    assert told in solve(tmp_path, silent)["summary"]
