"""Rigs and takes as USD pass the library's own validation and move as they were fitted."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import SolveError
from solver.mechanics.boundary import move_jaw
from solver.rig import ExpressionFit, Rig, ShapeFit, ShapeSystem, TetFit, TetSystem
from solver.rig.exporters import export_measured
from solver.rig.frames import MarkerFrame
from solver.rig.frames.animation_gltf import AnimatedSkin
from solver.similarity import small_motion
from solver.surface import Surface, vertex_normals
from solver.templates.builtin.build import builtin_expression
from tests.solver.block import block_model
from tests.solver.usd import played

pxr = pytest.importorskip("pxr", reason="USD is not installed: pip install 'myoface[usd]'")
from pxr import Usd, UsdGeom, UsdSkel, UsdValidation  # noqa: E402

from solver.rig.exporters.usd import read_back, write, write_sequence  # noqa: E402

ROOT = Path(__file__).parents[2]
EXPRESSIONS = {
    "smile": {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    "ah": {"jawOpen": 1.0},
    "Ah, wide-open": {"jawOpen": 0.5, "browInnerUp": 1.0},
    "Ah__wide_open": {"browInnerUp": 1.0},
}
HELD = {"smile": 24.0, "ah": 72.0, "Ah, wide-open": 120.0, "Ah__wide_open": 168.0}
"""Frames at which an expression is held."""


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Return a rig of the built-in face on the bones of a block."""
    skin = builtin_expression({})
    corners = 10.0 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    bone = Surface(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    model = replace(
        block_model(),
        skin=skin,
        face=np.arange(1000),
        bones={"cranium": bone, "mandible": bone.with_vertices(corners - 40.0)},
    )
    error = np.full(len(skin.vertices), np.nan)
    error[model.face] = 0.5
    fits = []
    for number, (name, weights) in enumerate(EXPRESSIONS.items()):
        shape = builtin_expression(weights).vertices
        rest = np.zeros((model.muscle_count, 6))
        b = number * np.array([0.1, 0.02, 0.5, -1.0, 2.0])
        fits.append(ExpressionFit(name, "train", rest, b, shape, shape, error, 0, 1, 1.0, 0.1))
    return Rig(model, model.weights, tuple(fits), {})


@pytest.fixture(scope="module")
def path(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("usd") / "rig.usdc"
    write(rig, path)
    return path


def faults(stage: Usd.Stage) -> list[str]:
    """Return what any of the library's validators says, as usdchecker does."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{each.GetName()}: {each.GetMessage()}" for each in found]


def test_the_library_finds_nothing_wrong(path: Path) -> None:
    assert faults(Usd.Stage.Open(str(path))) == []


def test_it_would_find_something(path: Path, tmp_path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    stage.Export(str(tmp_path / "broken.usda"))
    broken = Usd.Stage.Open(str(tmp_path / "broken.usda"))
    skin = broken.GetPrimAtPath("/Face/Skin")
    skin.RemoveAppliedSchema("SkelBindingAPI")
    broken.ClearMetadata("metersPerUnit")
    assert len(faults(broken)) >= 2


def test_what_a_tool_reads_first(path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    assert stage.GetDefaultPrim().GetPath() == "/Face"
    assert stage.GetDefaultPrim().IsA(UsdSkel.Root)
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.001
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 4 * 48.0)
    assert stage.GetTimeCodesPerSecond() == 30.0
    mesh = stage.GetPrimAtPath("/Face/Skin")
    assert list(UsdSkel.BindingAPI(mesh).GetBlendShapesAttr().Get()) == list(EXPRESSIONS)
    shapes = [each.GetName() for each in mesh.GetChildren() if each.IsA(UsdSkel.BlendShape)]
    assert shapes == ["smile", "ah", "Ah__wide_open", "Ah__wide_open_"]
    parts = [each.GetName() for each in mesh.GetChildren() if each.IsA(UsdGeom.Subset)]
    assert parts == ["skin", "eyes", "teeth", "mouth"]


def test_extents_hold_all_expressions(rig: Rig, path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    low, high = np.array(UsdSkel.Root(stage.GetDefaultPrim()).GetExtentAttr().Get())
    for fit in rig.expressions:
        mandible = move_jaw(rig.model.jaw, rig.model.bones["mandible"].vertices, fit.jaw)
        for points in (fit.skin, mandible):
            assert (points >= low - 1e-4).all()
            assert (points <= high + 1e-4).all()


def test_played_by_the_library_it_is_the_rig(rig: Rig, path: Path) -> None:
    """UsdSkel's own skinning, baked, gives every expression and the mandible's place."""
    points = played(path)
    neutral = rig.model.skin.vertices
    np.testing.assert_allclose(points("Skin", 0.0), neutral, atol=1e-4)
    smile = rig.expressions[0].skin
    np.testing.assert_allclose(points("Skin", 9.0), (neutral + smile) / 2, atol=2e-3)
    for fit in rig.expressions:
        np.testing.assert_allclose(points("Skin", HELD[fit.name]), fit.skin, atol=2e-3)
        mandible = move_jaw(rig.model.jaw, rig.model.bones["mandible"].vertices, fit.jaw)
        np.testing.assert_allclose(points("mandible", HELD[fit.name]), mandible, atol=1e-3)
        cranium = rig.model.bones["cranium"].vertices
        np.testing.assert_allclose(points("cranium", HELD[fit.name]), cranium, atol=1e-4)


def test_shapes_turn_the_normals_too(rig: Rig, path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    shape = UsdSkel.BlendShape(stage.GetPrimAtPath("/Face/Skin/ah"))
    moving = np.array(shape.GetPointIndicesAttr().Get())
    normals = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/Face/Skin")).GetNormalsAttr().Get())
    found = normals[moving] + np.array(shape.GetNormalOffsetsAttr().Get())
    expected = vertex_normals(rig.model.skin.with_vertices(rig.expressions[1].skin))[moving]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert len(moving) < len(normals)


def test_the_command_converts_a_rig_s_folder(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    run = "from myoface.cli import main; main()"
    command = [sys.executable, "-c", run, "solve", "export-rig", str(tmp_path), "--format", "usd"]
    command += ["-o", str(tmp_path), "--file", "rig.usda"]
    subprocess.run(command, cwd=ROOT, check=True, timeout=60)
    assert faults(Usd.Stage.Open(str(tmp_path / "rig.usda"))) == []
    command[-1] = "rig.fbx"
    child = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert child.returncode == 1
    assert "rig.fbx does not end in .usdc, .usda, .usd" in child.stderr


def test_every_system_is_a_variant(rig: Rig, tmp_path: Path) -> None:
    """A rig's muscles are shown by default where it has any, each other system when chosen."""
    smile, ah = rig.expressions[:2]
    held = {each.name: getattr(smile, each.name) for each in fields(ExpressionFit)}
    skins = {"smile": 0.5 * (smile.skin + rig.model.skin.vertices), "Ah, wide-open": ah.skin}
    own = {"weights": np.zeros(1), "jaw_on_top": np.zeros(5), "lengths": np.zeros(2)}
    tracks = [ShapeFit(**{**held, "name": name, "skin": skins[name]}, **own) for name in skins]
    tets = TetFit(**{**held, "skin": ah.skin}, tet_activations=np.zeros((1, 6)))
    systems = {
        "T": ShapeSystem(tuple(tracks), ("a",)),
        "P": TetSystem((tets,), np.zeros(1, np.int64)),
    }
    several = replace(rig, expressions=(smile,), systems=systems)
    made = export_measured(several, "usd", tmp_path / "rig.usdc")
    assert made.figures["max_mm"] < 2e-3
    stage = Usd.Stage.Open(str(made.path))
    variants = stage.GetDefaultPrim().GetVariantSet("system")
    assert set(variants.GetVariantNames()) == {"S", "T", "P"}
    assert variants.GetVariantSelection() == "S"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 2 * 48.0)
    wanted = {"S": {"smile": smile.skin}, "T": skins, "P": {"smile": ah.skin}}
    for system, expected in wanted.items():
        variants.SetVariantSelection(system)
        assert faults(stage) == []
        shown = tmp_path / f"{system}.usdc"
        stage.Export(str(shown))
        points = played(shown)
        for name, frame in (("smile", 24.0), ("Ah, wide-open", 72.0)):
            skin = expected.get(name, rig.model.skin.vertices)
            np.testing.assert_allclose(points("Skin", frame), skin, atol=2e-3)
        binding = UsdSkel.BindingAPI(stage.GetPrimAtPath("/Face/Skin"))
        assert list(binding.GetBlendShapesAttr().Get()) == list(expected)
    alone = export_measured(replace(several, expressions=()), "usd", tmp_path / "alone.usdc")
    others = Usd.Stage.Open(str(alone.path))
    assert others.GetDefaultPrim().GetVariantSet("system").GetVariantSelection() == "T"
    with pytest.raises(SolveError) as raised:
        read_back(replace(several, systems={"P": systems["T"]}), made.path)
    assert raised.value.code == "file.differs"


STATUS = ("fitted", "kept", "predicted", "smoothed", "fitted")


def marker_frame(row: int) -> MarkerFrame:
    """Return a frame of a take that begins before the file's 0: its jaw slides on one side."""
    mandible = np.eye(4)
    mandible[:3, :3] = Rotation.from_rotvec([0.1 * row, 0.02 * row, 0.05 * row]).as_matrix()
    mandible[:3, 3] = [0.5 * row, -row, 2.0 * row]
    pose = {"activations": np.full(3, 0.1 * row), "jaw": np.zeros(5), "tracks": np.zeros(3)}
    head = np.array([0.4 * row, 3.0, 0.2, 500.0, 1200.0 + row, 80.0])
    markers = {"marker_mm": np.zeros(2), "marker_weight": np.ones(2), "held": np.zeros(3)}
    figures = {"mean_mm": 0.1, "p95_mm": 0.2, "max_mm": 0.3, "coverage": 1.0, "seconds": 0.1}
    counts = {"inverted": 0, "iterations": 1, "marker_state": ("seen", "missing")}
    spread = {"sd": np.ones(6), "information": np.ones(6), "contraction_sd": np.zeros(0)}
    spread |= {"mandible": mandible, "head": head}
    return MarkerFrame(
        frame=2 * row - 3, status=STATUS[row], **pose, **markers, **figures, **counts, **spread
    )


@pytest.mark.parametrize("still", [False, True])
def test_a_take_plays_as_it_was_fitted(rig: Rig, tmp_path: Path, still: bool) -> None:
    neutral = rig.model.skin
    path = tmp_path / "sequence.usdc"
    away = 0.0 if still else rig.expressions[0].skin - neutral.vertices
    skins = [neutral.vertices + np.sin(1.3 * row) * away for row in range(len(STATUS))]
    animated = AnimatedSkin(neutral)
    for row, skin in enumerate(skins):
        animated.add(marker_frame(row), skin)
    write_sequence(path, rig.model, animated, 59.94)
    stage = Usd.Stage.Open(str(path))
    assert faults(stage) == []
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (-3.0, 5.0)
    assert stage.GetTimeCodesPerSecond() == pytest.approx(59.94)
    low, high = np.array(UsdGeom.Boundable(stage.GetDefaultPrim()).GetExtentAttr().Get())
    points = played(path)
    bones = rig.model.bones
    for row, skin in enumerate(skins):
        frame = marker_frame(row)
        head = small_motion(frame.head)
        motion = frame.mandible
        mandible = bones["mandible"].vertices @ motion[:3, :3].T + motion[:3, 3]
        expected = {"Skin": skin, "mandible": mandible, "cranium": bones["cranium"].vertices}
        for name, places in expected.items():
            shown = points(name, float(frame.frame))
            np.testing.assert_allclose(shown, head(places), atol=5e-3)
            assert (shown >= low - 5e-3).all()
            assert (shown <= high + 5e-3).all()
