"""A studio's rig of a block of flesh: its shapes by muscles, its files, and what a report says."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from solver.errors import InputError
from solver.jobs import blendshapes, build_studio_rig, run_job
from solver.rig.frames.read_back import split_glb
from tests.solver.jobs.test_learned_controls import NAMES, rig, template

__all__ = ["rig", "template"]  # fixtures
pytestmark = pytest.mark.long


@pytest.fixture
def built(template: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    for job in (blendshapes, build_studio_rig):
        monkeypatch.setattr(job, "read_template", lambda _: template)


@pytest.mark.usefixtures("built")
def test_shapes_are_the_muscles_and_have_arkit_s_names(
    rig: Path, template: SimpleNamespace, tmp_path: Path
) -> None:
    files = run_job("build_studio_rig", tmp_path, options={"driven_by": "joints"}, rig=rig)
    told = json.loads((tmp_path / "studio.json").read_text())
    assert set(told["shapes"]) == set(NAMES)
    assert told["not_settled_in_contact"] == []
    assert [each["code"] for each in told["notices"]] == ["studio.no_texture"]
    assert told["shapes_worst_mm"] < 0.3
    assert set(told["shapes"]["jawOpen"]["joints"]) == {"jaw"}
    assert "joints" not in told["shapes"]["mouthSmileLeft"]
    names = {file.name for file in files}
    assert {
        "studio.glb",
        "studio_half.glb",
        "studio_quarter.glb",
        "studio.png",
        "studio.usdc",
    } <= names
    assert {"blendshapes.npz", "expression_basis.npz"} <= names
    document, _ = split_glb(tmp_path / "studio.glb")
    targets = {name for mesh in document["meshes"] for name in mesh["extras"]["targetNames"]}
    assert set(NAMES) == targets
    # blendshapes of an earlier job are taken as they are
    again = tmp_path / "again"
    given = tmp_path / "blendshapes.npz"
    run_job("build_studio_rig", again, rig=rig, blendshapes=given)
    assert not (again / "expression_basis.npz").exists()
    shapes = json.loads((again / "studio.json").read_text())
    assert shapes["driven_by"] == "shapes"
    assert "joints" not in shapes["shapes"]["jawOpen"]


def test_a_template_without_expressions_is_told(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = SimpleNamespace(shapes=None)
    monkeypatch.setattr(build_studio_rig, "read_template", lambda _: plain)
    with pytest.raises(InputError, match="no expressions") as caught:
        run_job("build_studio_rig", tmp_path, rig=rig)
    assert caught.value.code == "blendshapes.none"
