"""The job that exports a rig: any exporter by its name, also of a rig of the release before."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.jobs import run_job
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig
from solver.rig.frames.read_back import validate_glb
from tests.solver.block import head_block

FIGURES = {"mean_mm": 0.0, "p95_mm": 0.0, "max_mm": 0.0}


@pytest.fixture(scope="module")
def rig() -> Rig:
    model = head_block()
    skin = model.skin.vertices + np.array([0.0, 3.0, 0.0])
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    none = np.zeros(len(skin))
    fit = ExpressionFit("smile", "train", a, np.zeros(5), skin, skin, none, 0, 1, 0.0, 0.0)
    muscles = {name: {"fibres": 1.0} for name in model.muscle_names}
    figures = {"expressions": {"smile": {**FIGURES, "muscles": muscles}}}
    return Rig(model, model.weights, (fit,), figures=figures)


def export(out: Path, files: dict[str, Path], **options: object) -> Path:
    made, report = run_job("export_rig", out, options=options, **files)
    told = json.loads(report.read_text())
    assert (report.name, told["file"]) == ("export.json", made.name)
    assert told["bytes"] == made.stat().st_size > 0
    assert list(told["files"]) == [made.name]
    return made


@pytest.mark.parametrize("format_", ["csv", "glb", "inside", "npz", "view"])
def test_every_exporter_is_a_format(rig: Rig, tmp_path: Path, format_: str) -> None:
    rig.save(tmp_path / "rig.npz")
    made = export(tmp_path / "out", {"rig": tmp_path / "rig.npz"}, format=format_)
    if format_ == "glb":
        assert validate_glb(made, ["smile"]) == []


def test_settings_are_the_exporter_s(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    files = {"rig": tmp_path / "rig.npz"}
    table = {"format": "csv", "file": "smile.csv"}
    made = export(tmp_path / "out", files, **table, settings={"decimals": 2})
    assert made.name == "smile.csv"
    assert ",1.00," in made.read_text()
    for settings in ({"digits": 2}, {"decimals": "two"}, {"decimals": -1}, {"decimals": "3"}):
        with pytest.raises(InputError) as caught:
            run_job("export_rig", tmp_path, options={**table, "settings": settings}, **files)
        assert caught.value.code == "export.options"
    for settings in ({"still_mm": "0.1"}, {"move_seconds": 0}, {"move_seconds": math.nan}):
        with pytest.raises(InputError) as caught:
            run_job("export_rig", tmp_path, options={"settings": settings}, **files)
        assert caught.value.code == "export.options"
    with pytest.raises(InputError, match="give its file another name"):
        run_job("export_rig", tmp_path, options={**table, "file": "export.json"}, **files)


def test_a_rig_of_the_release_before_becomes_one_file(rig: Rig, tmp_path: Path) -> None:
    rig.model.save(tmp_path / "model.npz")
    weights, fits = rig.save_as_0_1(tmp_path)
    files = {"model": tmp_path / "model.npz", "weights": weights, "rig": fits}
    made = export(tmp_path / "out", files, format="npz")
    found = Rig.load(made)
    assert found.model.sha256 == rig.model.sha256
    assert [fit.name for fit in found.expressions] == ["smile"]
    assert replace(found, figures=rig.figures).known_figures() == rig.figures
