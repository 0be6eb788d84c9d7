"""The table of exporters: every one declares itself, and writes what it says."""

from __future__ import annotations

from dataclasses import is_dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.kinds.export_rig import FORMATS
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import export, export_all, export_measured, exporter
from solver.rig.report import report
from solver.rig.report.certificate import certify
from tests.solver.block import block_model
from worker.attempt import MEDIA_TYPES


@pytest.fixture(scope="module")
def rig() -> Rig:
    model = block_model()
    skin = model.skin.vertices + np.array([0.0, 0.5, 0.0])
    error = np.full(len(skin), np.nan)
    error[model.face] = 0.5
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    fit = ExpressionFit(
        "smile", "train", a, np.zeros(5), skin, skin, error, 0, 3, 0.5, 0.1, x=model.rest
    )
    made = Rig(model, model.weights, (fit,))
    return replace(made, figures=report(made, certify(Face(model), made, {})))


def available() -> list[str]:
    return [name for name in FORMATS if name != "usd" or find_spec("pxr")]


@pytest.mark.parametrize("name", available())
def test_an_exporter_declares_itself_and_writes_its_file(
    name: str, rig: Rig, tmp_path: Path
) -> None:
    module = exporter(name)
    suffix = Path(module.FILE).suffix
    assert MEDIA_TYPES.get(suffix, "application/octet-stream") == module.MEDIA_TYPE
    assert is_dataclass(module.Options)
    file = export(rig, name, tmp_path / "there" / module.FILE)
    assert file.stat().st_size > 0
    again = export(rig, name, tmp_path / module.FILE)
    if name not in ("npz", "usd"):  # their containers hold times
        assert again.read_bytes() == file.read_bytes()


@pytest.mark.parametrize("name", available())
def test_a_file_of_another_face_is_refused(name: str, rig: Rig, tmp_path: Path) -> None:
    module = exporter(name)
    made = export_measured(rig, name, tmp_path / module.FILE)
    assert 0.0 <= (made.figures.get("max_mm") or 0.0) < 1e-3
    [fit] = rig.expressions
    assert fit.x is not None
    moved = fit.skin.copy()
    x = fit.x.copy()
    moved[7] += 0.3
    x[7] += 0.3
    others = replace(fit, skin=moved, x=x, activations=fit.activations + 0.1)
    with pytest.raises(SolveError, match="read back") as raised:
        module.read_back(replace(rig, expressions=(others,)), made.path, module.Options())
    assert (raised.value.code, raised.value.context["file"]) == ("file.differs", module.FILE)
    if name != "csv":
        assert (raised.value.context["frame"], raised.value.context["vertex"]) == ("smile", 7)


def test_every_rig_has_the_files_that_the_service_serves(rig: Rig, tmp_path: Path) -> None:
    names = {each.path.name for each in export_all(rig, tmp_path)}
    assert {"rig.npz", "rig.glb", "activations.csv", "view.bin", "inside.bin"} <= names
    assert ("rig.usdc" in names) == bool(find_spec("pxr"))
    assert names == {path.name for path in tmp_path.iterdir()}
    assert (
        export(Rig.load(tmp_path), "csv", tmp_path / "again.csv").read_bytes()
        == (tmp_path / "activations.csv").read_bytes()
    )


@pytest.mark.parametrize(
    ("name", "options", "code"),
    [
        ("fbx", {}, "export.unknown"),
        ("csv", {"digits": 3}, "export.options"),
        ("usd", {"scale": 2}, "export.options"),
    ],
)
def test_what_is_not_there_is_refused(
    rig: Rig, tmp_path: Path, name: str, options: dict[str, int], code: str
) -> None:
    with pytest.raises(InputError) as raised:
        export(rig, name, tmp_path / "file", options)
    assert raised.value.code == code


def test_a_rig_without_figures_has_no_table(rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(InputError) as raised:
        export(replace(rig, figures=None), "csv", tmp_path / "a.csv")
    assert raised.value.code == "export.figures"


@pytest.mark.parametrize("name", [each for each in available() if each in ("glb", "usd")])
def test_a_rig_without_expressions_is_its_neutral(name: str, rig: Rig, tmp_path: Path) -> None:
    file = export(replace(rig, expressions=()), name, tmp_path / exporter(name).FILE)
    assert file.stat().st_size > 0
