"""The job that edits a person: a block of flesh that gets fat, and half of it paralysed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from solver.drawing.sheet import Sheet
from solver.errors import InputError
from solver.fitting.face import Face, Pose
from solver.jobs import run_job
from solver.progress import Step
from solver.rig import ExpressionFit, Rig
from solver.rig.frames.read_back import validate_glb
from tests.solver.block import head_block

pytestmark = pytest.mark.long

MODEL = head_block((7, 5, 1))
PALSY = {"kind": "paralysis", "side": "left"}
FAT = {"kind": "fat", "f_min": 1.0, "f_max": 1.2}


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig with an expression of both sides."""
    file = tmp_path_factory.mktemp("rig") / "rig.npz"
    face = Face(MODEL)
    a = np.array([[0.8, 0.02, 0.0, 1.1, 0.0, 1.1], [0.8, -0.02, 0.0, 1.1, 0.0, 1.1]])
    b = np.array([0.04, 0.0, 0.0, 0.0, 0.0])
    state = face.continuation(face.rest, Pose(a, b))
    skin = face.whole_skin(state.x, b)
    error = np.zeros(len(skin))
    fit = ExpressionFit("wide", "train", a, b, skin, skin, error, 0, 1, 0.0, 0.0, state.x)
    Rig(MODEL, MODEL.weights, (fit,)).save(file)
    return file


def run(rig: Path, out: Path, *edits: dict[str, object], **scene: object) -> list[Step]:
    steps: list[Step] = []
    options = {"scene": {"edits": list(edits), **scene}}
    files = run_job("edit", out, options=options, progress=steps.append, rig=rig)
    assert all(file.stat().st_size > 0 for file in files)
    return steps


def test_a_paralysed_side_stays_and_the_other_moves(rig: Path, tmp_path: Path) -> None:
    steps = run(rig, tmp_path, PALSY)
    assert [step.fraction for step in steps] == sorted(step.fraction for step in steps)
    assert (steps[0].phase, steps[-1].phase, steps[-1].fraction) == ("read", "done", 1.0)
    report = json.loads((tmp_path / "edit.json").read_text())
    assert {"edit.npz", "edit.glb"} == set(report["files"])
    assert max(each["max_mm"] for each in report["files"].values()) < 2e-3
    [wide] = report["expressions"]
    assert wide["status"] == "found"
    assert wide["inverted"] == 0
    # before the edit the expression comes back as the rig has it
    assert wide["off_fit_mm"] < 1e-3 < wide["motion_mm"]
    assert wide["drift_mm"] > 0.1
    assert report["neutral"]["moved_max_mm"] < 1e-6
    assert report["volume"]["change_ml"] == pytest.approx(0.0, abs=1e-6)
    with np.load(tmp_path / "edit.npz") as data:
        assert data["names"].tolist() == ["neutral", "wide"]
        np.testing.assert_allclose(data["skin"][0], MODEL.skin.vertices, atol=1e-4)
        assert data["growth"].shape == data["density"].shape == (len(MODEL.tets),)
    assert validate_glb(tmp_path / "edit.glb", ["unedited", "wide"]) == []


def test_a_fat_block_is_larger_and_its_expression_still_reaches(rig: Path, tmp_path: Path) -> None:
    [warning] = [step for step in run(rig, tmp_path, FAT) if step.phase == "warning"]
    assert "fat changes everywhere alike" in (warning.message or "")
    report = json.loads((tmp_path / "edit.json").read_text())
    assert report["flesh"]["growth"] == pytest.approx([1.0, 1.2], abs=0.1)
    assert 5.0 < report["volume"]["change_percent"] < 100 * (1.2**3 - 1)
    assert {name: each["outward_ml"] > 0 for name, each in report["regions"].items()} == {
        "left": True,
        "right": True,
    }
    [wide] = report["expressions"]
    assert wide["drift_mm"] < 0.5 * wide["motion_mm"]
    assert Image.open(tmp_path / "edit.png").width > 1000


def test_the_picture_says_how_many_expressions_it_leaves_out(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    headings: list[str] = []
    monkeypatch.setattr(Sheet, "heading", lambda _page, _title, detail: headings.append(detail))
    run(rig, tmp_path / "one", PALSY)
    assert "expressions are shown" not in headings[0]
    [wide] = Rig.load(rig).expressions
    many = tuple(replace(wide, name=f"wide_{number}") for number in range(5))
    Rig(MODEL, MODEL.weights, many).save(tmp_path / "rig.npz")
    run(tmp_path / "rig.npz", tmp_path / "many", PALSY)
    assert headings[1].endswith("; 4 of 5 expressions are shown")


def test_expressions_may_be_called_as_an_edit_calls_its_own(rig: Path, tmp_path: Path) -> None:
    [wide] = Rig.load(rig).expressions
    named = tuple(replace(wide, name=name) for name in ("unedited", "neutral"))
    Rig(MODEL, MODEL.weights, named).save(tmp_path / "rig.npz")
    run(tmp_path / "rig.npz", tmp_path / "out", PALSY)
    with np.load(tmp_path / "out" / "edit.npz") as data:
        assert data["names"].tolist() == ["neutral_", "unedited", "neutral"]
    assert validate_glb(tmp_path / "out" / "edit.glb", ["unedited_", "unedited", "neutral"]) == []


@pytest.mark.parametrize(
    ("scene", "code"),
    [
        ({"edits": [{"kind": "wings"}]}, "scene.schema"),
        ({"edits": [{"kind": "paralysis", "muscles": ["tongue"]}]}, "scene.muscle"),
        ({"edits": [FAT | {"map": {"spots": ["pogonion"], "radius_mm": 10}}]}, "scene.landmark"),
        ({"edits": [FAT | {"map": {"asset": "painted"}}]}, "scene.asset"),
    ],
)
def test_a_scene_that_does_not_fit_is_refused_at_once(
    rig: Path, tmp_path: Path, scene: dict[str, object], code: str
) -> None:
    with pytest.raises(InputError) as raised:
        run(rig, tmp_path, **scene)  # type: ignore[arg-type]
    assert raised.value.code == code
    assert not list(tmp_path.iterdir())
