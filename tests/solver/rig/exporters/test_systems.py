"""``systems.glb``: a face of every system, which share what they have in common."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest

from solver.errors import InputError, SolveError
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig, ShapeFit, ShapeSystem
from solver.rig.exporters import export, export_measured, systems
from solver.rig.frames.read_back import read_glb
from solver.storage import read_container
from tests.solver.block import block_model


def fitted(rig: Rig, name: str, away: float) -> ExpressionFit:
    """Return an expression whose skin is moved."""
    skin = rig.model.skin.vertices + np.array([0.0, away, 0.0])
    a = np.tile(IDENTITY, (rig.model.muscle_count, 1))
    error = np.full(len(skin), away)
    return ExpressionFit(name, "test", a, np.zeros(5), skin, skin, error, 0, 1, 0.0, 0.0)


def by_shapes(rig: Rig, name: str, away: float) -> ShapeFit:
    held = {
        each.name: getattr(fitted(rig, name, away), each.name) for each in fields(ExpressionFit)
    }
    own = {"weights": np.zeros(1), "jaw_on_top": np.zeros(5), "lengths": np.zeros(2)}
    return ShapeFit(**held, **own)


@pytest.fixture
def rig() -> Rig:
    model = block_model()
    empty = Rig(model, model.weights, ())
    tracks = ShapeSystem((by_shapes(empty, "kiss", 2.0), by_shapes(empty, "smile", 3.0)), ("a",))
    return replace(
        empty,
        expressions=(fitted(empty, "smile", 1.0),),
        systems={"T": tracks, "B": ShapeSystem((), ("a",))},
    )


def test_faces_share_the_skin_and_show_an_expression_at_one_time(rig: Rig, tmp_path: Path) -> None:
    path = export(rig, "systems", tmp_path / "systems.glb", {"apart": 2.0})
    document = pygltflib.GLTF2().load(str(path))
    assert [node.name for node in document.nodes] == ["face.S", "face.T", "face.B"]
    assert [node.translation[0] for node in document.nodes] == pytest.approx([0.0, 0.1, 0.2])
    names = [mesh.extras.get("targetNames", []) for mesh in document.meshes]
    assert names == [["smile"], ["kiss", "smile"], []]
    parts = [mesh.primitives[0] for mesh in document.meshes]
    shared = {(part.attributes.POSITION, part.attributes.NORMAL, part.indices) for part in parts}
    assert len(shared) == 1
    assert len({part.attributes._ERROR_MM for part in parts}) == 3
    muscles, tracks = (systems.read_glb(path, node) for node in (0, 1))
    times = np.array([0.8, 2.4])  # the two expressions, each held
    np.testing.assert_allclose(muscles.motion(times)[0], [[1.0], [0.0]])
    np.testing.assert_allclose(tracks.motion(times)[0], [[0.0, 1.0], [1.0, 0.0]])


def test_the_page_s_file_is_of_one_system(rig: Rig, tmp_path: Path) -> None:
    path = export(rig, "view", tmp_path / "view_T.bin", {"system": "T"})
    found = read_container(path)
    assert [each["name"] for each in found.header["expressions"]] == ["kiss", "smile"]
    assert found.header["expressions"][1]["mean_mm"] == pytest.approx(3.0)
    np.testing.assert_allclose(found.arrays["skin/0"][:, 1], 2.0)
    with pytest.raises(InputError, match="it has S, T, B") as refused:
        export(rig, "view", tmp_path / "none.bin", {"system": "P"})
    assert refused.value.code == "export.options"


def test_a_rig_whose_muscles_are_not_fitted_shows_what_is(rig: Rig, tmp_path: Path) -> None:
    alone = replace(rig, expressions=())
    assert (rig.default_system, alone.default_system) == ("S", "T")
    assert replace(alone, systems={}).default_system == "S"
    path = export(alone, "glb", tmp_path / "rig.glb")
    found = read_glb(path).expressions()
    np.testing.assert_allclose(
        found["smile"] - rig.model.skin.vertices, [[0.0, 3.0, 0.0]] * len(found["smile"]), atol=1e-3
    )


def test_a_file_of_another_system_is_refused(rig: Rig, tmp_path: Path) -> None:
    made = export_measured(rig, "systems", tmp_path / "systems.glb")
    assert made.figures["max_mm"] < 1e-3
    other = replace(rig, systems={"T": ShapeSystem((by_shapes(rig, "kiss", 2.5),), ("a",))})
    with pytest.raises(SolveError) as error:
        systems.read_back(other, made.path)
    assert error.value.code == "file.differs"
    with pytest.raises(InputError) as refused:
        export(rig, "systems", tmp_path / "none.glb", {"apart": -1.0})
    assert refused.value.code == "export.options"
