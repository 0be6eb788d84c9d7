"""Jobs that play scenes: a block of flesh on keys, on a recording, killed and gone on with."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from solver.anatomy.template import ShapeBasis
from solver.anatomy.tetrahedra import volume_ml
from solver.animation.blendshapes import Blendshapes, Solved
from solver.errors import InputError, SolveError
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face, Pose
from solver.jobs import blendshapes, run_job
from solver.mechanics.flesh import IDENTITY
from solver.progress import Step
from solver.rig import ExpressionFit, Rig
from solver.rig.frames.read_back import LIMIT_MM, validate_glb
from solver.scans.live_link import ARKIT_NAMES
from tests.solver.block import head_block, thinner

pytestmark = pytest.mark.long

MODEL = head_block((7, 5, 1))
WIDE = np.array([[0.8, 0.02, 0.0, 1.1, 0.0, 1.1], [0.8, -0.02, 0.0, 1.1, 0.0, 1.1]])
JAW = np.array([0.04, 0.0, 0.0, 0.0, 0.0])
KEYS = [{"time": 0}, {"time": 0.5, "expressions": {"wide": 1.0}}]
GLASS = {"name": "glass", "mesh": {"box_mm": [60, 60, 4]}, "at": [75, 60, 80]}


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig with an expression of both sides."""
    file = tmp_path_factory.mktemp("rig") / "rig.npz"
    face = Face(MODEL)
    state = face.continuation(face.rest, Pose(WIDE, JAW))
    skin = face.whole_skin(state.x, JAW)
    error = np.zeros(len(skin))
    fit = ExpressionFit("wide", "train", WIDE, JAW, skin, skin, error, 0, 1, 0.0, 0.0, state.x)
    Rig(MODEL, MODEL.weights, (fit,)).save(file)
    return file


def play(
    rig: Path, out: Path, scene: dict[str, Any], assets: dict[str, Path] | None = None, **how: Any
) -> dict[str, Any]:
    options = {"scene": scene}
    files = run_job("simulate", out, options=options, captures=assets, rig=rig, **how)
    assert all(file.stat().st_size > 0 for file in files)
    report: dict[str, Any] = json.loads((out / "animation.json").read_text())
    assert report["glb"]["max_error_mm"] < LIMIT_MM
    assert report["files"]["animation.npz"]["max_mm"] < 1e-4
    return report


def skins(out: Path) -> np.ndarray:
    with np.load(out / "animation.npz") as data:
        found: np.ndarray = data["skin"]
    return found


def test_a_keyed_expression_is_reached(rig: Path, tmp_path: Path) -> None:
    steps: list[Step] = []
    film = tmp_path / "animation.mp4"
    film.write_text("the film of a scene that was played before")
    report = play(rig, tmp_path, {"fps": 10, "keys": KEYS}, progress=steps.append)
    assert (report["frames"], report["duration"]) == (6, 0.5)
    assert report["inverted"] == report["behind_teeth"] == 0
    assert [step.fraction for step in steps] == sorted(step.fraction for step in steps)
    assert "frame 6 of 6" in [step.message for step in steps]
    assert not film.exists()
    face = Face(MODEL)
    wide = face.continuation(face.rest, Pose(WIDE, JAW))
    at_rest = volume_ml(MODEL.rest, MODEL.tets)
    grown = volume_ml(wide.x, MODEL.tets)
    assert report["volume_ml"] == pytest.approx(at_rest, abs=0.01)
    change = 100.0 * (grown / at_rest - 1.0)
    assert abs(change) > 0.1
    assert change == pytest.approx(max(report["volume_change_percent"], key=abs), rel=0.05)
    moved = skins(tmp_path)
    np.testing.assert_allclose(moved[0], MODEL.skin.vertices, atol=1e-3)
    np.testing.assert_allclose(moved[-1], face.face_points(wide.x), atol=0.05)
    assert np.abs(moved[-1] - moved[0]).max() > 2.0
    shapes = [f"shape_{number}" for number in range(1, report["glb"]["shapes"])]
    assert validate_glb(tmp_path / "animation.glb", ["start", *shapes]) == []
    Image.open(tmp_path / "animation.png").verify()
    chunk = json.loads(next((tmp_path / "frames").iterdir()).read_text())
    assert chunk["picture"]


def test_what_was_interrupted_goes_on_as_if_it_had_not_been(rig: Path, tmp_path: Path) -> None:
    scene = {
        "fps": 20,
        "duration": 1.2,
        "keys": KEYS,
        "mode": "dynamic",
        "head": [{"time": 0}, {"time": 1, "rotation_deg": [0, 30, 0]}],
        "forces": [{"kind": "wind", "m_s": [20, 0, -20], "gusts": 0.5}],
    }
    play(rig, tmp_path / "whole", scene)

    def stop(step: Step, /) -> None:
        if step.iteration == 13:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play(rig, tmp_path / "parts", scene, progress=stop)
    ready = {path: path.stat().st_mtime_ns for path in (tmp_path / "parts/frames").iterdir()}
    assert sorted(path.name for path in ready)[-1].endswith("-000012.json")
    report = play(rig, tmp_path / "parts", scene, resume=True)
    assert report["frames"] == 25
    assert all(path.stat().st_mtime_ns == written for path, written in ready.items())
    np.testing.assert_allclose(skins(tmp_path / "parts"), skins(tmp_path / "whole"), atol=0.02)
    (tmp_path / "more.csv").write_text("a file that the scene does not name")
    for other, assets in (({**scene, "damping": 2}, {}), (scene, {"more": tmp_path / "more.csv"})):
        with pytest.raises(InputError) as raised:
            play(rig, tmp_path / "parts", other, assets, resume=True)
        assert raised.value.code == "simulate.other_scene"
    last = sorted((tmp_path / "parts/frames").iterdir())[-1]
    last.write_bytes(last.read_bytes()[:-99])
    with pytest.raises(InputError, match=last.name) as raised:
        play(rig, tmp_path / "parts", scene, resume=True)
    assert raised.value.code == "simulate.frames"


def test_what_can_not_be_reached_is_told_and_the_frames_before_stay(
    rig: Path, tmp_path: Path
) -> None:
    """A glass that cuts through flesh and bone."""
    scene = {
        "fps": 5,
        "objects": [
            {**GLASS, "path": [{"time": 0}, {"time": 0.4}, {"time": 1, "move_mm": [0, 0, -70]}]}
        ],
        "duration": 1,
    }
    with pytest.raises(SolveError) as raised:
        play(rig, tmp_path, scene)
    assert raised.value.code in ("simulate.jammed", "simulate.diverged")
    last = sorted((tmp_path / "frames").iterdir())[-1].stem
    assert int(last.split("-")[1]) == raised.value.context["frame"] - 1 >= 2


@pytest.mark.parametrize(
    ("scene", "code"),
    [
        ({"fps": "fast"}, "scene.schema"),
        ({"keys": [{"time": 0, "expressions": {"grin": 1}}]}, "scene.expression"),
        ({"keys": [{"time": 0, "muscles": {"grin": 0.9}}]}, "scene.muscle"),
        ({"keys": [{"time": 1}, {"time": 1}]}, "scene.times"),
        ({"keys": [{"time": 0, "jaw": {"open_deg": 60}}]}, "scene.jaw"),
        ({"keys": [{"time": 0, "jaw": {"move_mm": [0, -21, 0]}}]}, "scene.jaw"),
        ({"head": [{"time": 1}, {"time": 0}]}, "scene.times"),
        ({"forces": [{"kind": "point", "at": "nose", "mn": [0, 0, 1]}]}, "scene.landmark"),
        (
            {"edits": [{"kind": "stiffness", "factor": 2, "map": {"regions": ["ear"]}}]},
            "scene.region",
        ),
        ({"edits": [{"kind": "paralysis", "muscles": ["ear"]}]}, "scene.muscle"),
        ({"edits": [{"kind": "density", "factor": 2, "map": {"asset": "map"}}]}, "scene.map"),
        ({"objects": [{"name": "glass", "mesh": {"asset": "glass"}}]}, "scene.asset"),
        ({"objects": [{**GLASS, "at": [75, 60, 46]}]}, "scene.object_inside"),
        ({"objects": [{**GLASS, "at": [75, 60, 46]}, GLASS]}, "scene.object_name"),
        ({"objects": [{**GLASS, "path": [{"time": 1}, {"time": 1}]}]}, "scene.times"),
        ({"objects": [{"name": "map", "mesh": {"asset": "map"}}]}, "scan.format"),
        ({"objects": [{"name": "large", "mesh": {"asset": "large"}}]}, "scene.object_large"),
        ({"duration": 600, "fps": 240}, "scene.long"),
        (
            {"objects": [{"name": "open", "mesh": {"asset": "open"}, "at": [0, 0, 300]}]},
            "scene.object_open",
        ),
    ],
)
def test_bad_scenes_are_refused_before_anything_is_solved(
    rig: Path, tmp_path: Path, scene: dict[str, Any], code: str
) -> None:
    np.save(tmp_path / "map.npy", np.ones(3))
    (tmp_path / "open.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 2 3\nf 1 2 4\n")
    trimesh.creation.icosphere(6).export(tmp_path / "large.stl")
    names = ("map.npy", "open.obj", "large.stl")
    assets = {name[:-4]: tmp_path / name for name in names}
    with pytest.raises(InputError) as raised:
        play(rig, tmp_path / "out", scene, assets=assets)
    assert raised.value.code == code
    assert not (tmp_path / "out" / "frames").exists()


def recording(path: Path, smiles: list[float], **columns: str) -> Path:
    """Write a Live Link recording in which the left half smiles."""
    with path.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["Timecode", *ARKIT_NAMES])
        for number, smile in enumerate(smiles):
            weights = [smile if name == "mouthSmileLeft" else 0.0 for name in ARKIT_NAMES]
            rows.writerow([f"00:00:00:{2 * number:02d}.000", *weights])
    return path


def test_a_recording_is_played_by_the_muscles(rig: Path, tmp_path: Path) -> None:
    left = np.array([WIDE[0], IDENTITY])
    shapes = {"mouthSmile_L": Solved(Pose(left, np.zeros(5)), 0.1)}
    Blendshapes(MODEL.muscle_names, shapes).save(tmp_path / "shapes.npz", MODEL, MODEL.weights)
    take = recording(tmp_path / "take.csv", [0.0, 0.5, 1.0, 1.0])
    run_job(
        "animate",
        tmp_path / "out",
        options={"scene": {"recording": {"asset": "take"}}},
        captures={"take": take},
        blendshapes=tmp_path / "shapes.npz",
        rig=rig,
    )
    report = json.loads((tmp_path / "out/animation.json").read_text())
    assert (report["frames"], report["blendshapes"]) == (4, 1)
    moved = skins(tmp_path / "out")
    assert np.abs(moved[2] - moved[0]).max() > 1.0
    np.testing.assert_allclose(moved[3], moved[2], atol=0.05)
    kept = Blendshapes.load(tmp_path / "out/blendshapes.npz", MODEL, MODEL.weights)
    assert kept.shapes.keys() == shapes.keys()


def test_the_certificate_tells_what_a_neck_could_not_do(rig: Path, tmp_path: Path) -> None:
    """A recorded head turns to the side by 115 degrees, within a second."""
    shapes = tmp_path / "shapes.npz"
    rest = {"mouthSmile_L": Solved(Pose(np.array([IDENTITY] * 2), np.zeros(5)), 0.1)}
    Blendshapes(MODEL.muscle_names, rest).save(shapes, MODEL, MODEL.weights)
    take = tmp_path / "take.csv"
    with take.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["Timecode", *ARKIT_NAMES, "HeadYaw", "HeadPitch", "HeadRoll"])
        for second, yaw in enumerate([0.0, 0.4, 0.8, 2.0]):
            rows.writerow([f"00:00:{second:02d}:00.000", *[0.0] * len(ARKIT_NAMES), yaw, 0, 0])
    neck = {"muscles": False, "skin": False}
    head = [{"time": 0}, {"time": 3, "move_mm": [0, 20, 0]}]
    steps: list[Step] = []
    run_job(
        "animate",
        tmp_path / "out",
        options={"scene": {"recording": {"asset": "take"}, "neck": neck, "head": head}},
        captures={"take": take},
        progress=steps.append,
        blendshapes=shapes,
        rig=rig,
    )
    report = json.loads((tmp_path / "out/animation.json").read_text())
    told = {notice["code"]: notice for notice in report["notices"]}
    assert told.keys() == {"neck.range", "neck.reach"}
    assert (told["neck.range"]["count"], told["neck.range"]["first_frame"]) == (1, 3)
    assert told["neck.range"]["beyond_deg"] == pytest.approx(45.0, abs=5.0)
    assert told["neck.reach"]["moved_mm"] == pytest.approx(20.0, abs=0.1)
    assert report["neck"]["held_frames"] == 1
    warned = {step.message for step in steps if step.phase == "warning"}
    assert {notice["message"] for notice in told.values()} <= warned
    with np.load(tmp_path / "out/animation.npz") as data:
        assert data["head_held"].tolist() == [False, False, False, True]


def test_the_rig_s_basis_is_solved_once_and_left(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wide = np.array([Rig.load({"rig": rig}).expressions[0].skin - MODEL.skin.vertices], np.float32)
    none = np.zeros((0, *wide.shape[1:]), np.float32)
    template = SimpleNamespace(shapes=ShapeBasis(none, wide, ("mouthSmileLeft",)))
    monkeypatch.setattr(blendshapes, "read_template", lambda _: template)
    take = recording(tmp_path / "take.csv", [0.0, 1.0])
    solve = ExpressionBasis.solve
    solved = []

    def count(*given: Any, **how: Any) -> ExpressionBasis:
        solved.append(given)
        return solve(*given, **how)

    monkeypatch.setattr(ExpressionBasis, "solve", count)
    steps: list[Step] = []

    def warnings() -> list[str]:
        return [str(step.message) for step in steps if step.phase == "warning"]

    def mean_mm(folder: str, *, of: Path = rig, **left: Path) -> float:
        options = {"scene": {"recording": {"asset": "take"}}}
        out = tmp_path / folder
        captures = {"take": take}
        steps.clear()
        told = steps.append
        run_job("animate", out, options=options, captures=captures, rig=of, progress=told, **left)
        report = json.loads((out / "animation.json").read_text())
        return float(report["blendshapes_mean_mm"])

    first = mean_mm("first")
    basis = tmp_path / "first" / "expression_basis.npz"
    assert mean_mm("again", expression_basis=basis) == pytest.approx(first, abs=0.01)
    assert len(solved) == 1
    assert not [each for each in warnings() if basis.name in each]
    assert (tmp_path / "again" / basis.name).read_bytes() == basis.read_bytes()
    mean_mm("shapes", blendshapes=tmp_path / "first" / "blendshapes.npz")
    assert len(solved) == 1
    other = tmp_path / "other.npz"
    replace(Rig.load({"rig": rig}), weights=thinner(MODEL.weights, 2)).save(other)
    mean_mm("other", of=other, expression_basis=basis)
    assert len(solved) == 2
    reason = "is of a rig with another muscle geometry: it is not used"
    assert f"{basis.name} {reason}" in warnings()


@pytest.mark.parametrize(
    ("neck", "code"),
    [
        ({"skin": False}, "neck.extra"),
        ({"pushes": [{"time": 0, "at": "nowhere", "newtons": [1, 0, 0]}]}, "scene.landmark"),
    ],
)
def test_a_neck_that_cannot_move_is_told_before_blendshapes_are_solved(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, neck: dict[str, Any], code: str
) -> None:
    if code == "neck.extra":
        monkeypatch.setitem(sys.modules, "mujoco", None)
    take = recording(tmp_path / "take.csv", [0.0, 0.5])
    scene = {"recording": {"asset": "take"}, "neck": {"skin": False, **neck}}
    how: dict[str, Any] = {"options": {"scene": scene}, "captures": {"take": take}}
    steps: list[Step] = []
    with pytest.raises(InputError) as raised:
        run_job("animate", tmp_path / "out", progress=steps.append, **how, rig=rig)
    assert raised.value.code == code
    assert [step.phase for step in steps] == ["read"]


@pytest.mark.parametrize(
    ("scene", "code"),
    [
        ({"recording": {"asset": "mesh"}}, "live_link.columns"),
        ({"recording": {"asset": "take", "start": 3}}, "scene.frames"),
        ({"recording": {"asset": "take"}, "head": [{"time": 1}, {"time": 0}]}, "scene.times"),
        (
            {"recording": {"asset": "take"}, "objects": [{**GLASS, "at": [75, 60, 46]}]},
            "scene.object_inside",
        ),
    ],
)
def test_bad_scenes_are_refused_before_blendshapes_are_solved(
    rig: Path, tmp_path: Path, scene: dict[str, Any], code: str
) -> None:
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3\n")
    take = recording(tmp_path / "take.csv", [0.0, 0.5, 1.0])
    how = {"options": {"scene": scene}, "captures": {"take": take, "mesh": tmp_path / "mesh.obj"}}
    steps: list[Step] = []
    with pytest.raises(InputError) as raised:
        run_job("animate", tmp_path / "out", progress=steps.append, **how, rig=rig)
    assert raised.value.code == code
    assert [step.phase for step in steps] == ["read"]
