"""The files of a rig: what is written is what was solved, and other programs can read it."""

from __future__ import annotations

import csv
import json
from dataclasses import astuple, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import scipy.sparse as sp

from solver.drawing.head import skin_parts
from solver.fitting.face import Face
from solver.meshio.registered import read_registered
from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import csv as csv_exporter
from solver.rig.exporters import glb, write_rig
from solver.rig.frames.read_back import validate_glb
from solver.rig.report import report
from solver.rig.report.certificate import Certificate, certify
from solver.rig.round_trip import RoundTrip
from solver.storage import write_json
from solver.surface import Surface
from tests.fixtures import ict_capture, small_capture, small_model

NAMES = ["smile", "surprise", "ah"]
SHARE = 0.9  # the made-up fits reach this much of each expression


@pytest.fixture(scope="module")
def model() -> SubjectModel:
    """Return a subject model that carries a whole topology: ears, eyes, teeth, tongue and neck."""
    return small_model()


@pytest.fixture(scope="module")
def rig(model: SubjectModel) -> Rig:
    rng = np.random.default_rng(4)
    return Rig(
        model=model,
        weights=model.weights,
        expressions=tuple(_fit(model, name, rng) for name in NAMES),
        seconds={"geometry": 1.25},
    )


@pytest.fixture(scope="module")
def certificate(rig: Rig) -> Certificate:
    return certify(Face(rig.model), rig, {"rounds": 2})


def _fit(model: SubjectModel, name: str, rng: np.random.Generator) -> ExpressionFit:
    neutral = model.skin.vertices
    target = small_capture(name).vertices
    skin = neutral + SHARE * (target - neutral)
    error = np.full(len(skin), np.nan)
    error[model.face] = np.linalg.norm(target - skin, axis=1)[model.face]
    return ExpressionFit(
        name=name,
        role="test" if name == "ah" else "train",
        activations=rng.standard_normal((model.muscle_count, 6)),
        jaw=rng.standard_normal(5),
        skin=skin,
        target=target,
        error_mm=error,
        inverted=1,
        iterations=7,
        seconds=0.5,
        objective=12.0,
    )


def test_flesh_and_round_trips_come_back(rig: Rig, tmp_path: Path) -> None:
    trip = RoundTrip(0.01, 0.2, 0.02, 0.3, np.nan)
    first, *others = rig.expressions
    known = replace(first, x=rig.model.rest + 1e-9, round_trip=trip)
    replace(rig, expressions=(known, *others)).save(tmp_path / "rig.npz")
    loaded = Rig.load(tmp_path / "rig.npz").expressions
    for before, after in zip(rig.expressions, loaded, strict=True):
        assert (before.name, before.role, before.inverted) == (after.name, after.role, 1)
        np.testing.assert_array_equal(before.activations, after.activations)
        np.testing.assert_array_equal(before.jaw, after.jaw)
        np.testing.assert_allclose(before.skin, after.skin, atol=1e-4)
        np.testing.assert_allclose(before.error_mm, after.error_mm, atol=1e-5)
    np.testing.assert_array_equal(loaded[0].x, known.x)
    np.testing.assert_array_equal(astuple(loaded[0].round_trip), astuple(trip))
    assert loaded[1].x is loaded[1].round_trip is None


def test_weights_come_back_with_their_zeros(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    loaded = Rig.load(tmp_path).weights
    assert isinstance(loaded, sp.csr_array)
    assert loaded.shape == rig.weights.shape
    assert loaded.nnz == rig.weights.nnz
    assert abs(loaded - rig.weights).max() == 0


def test_report_means_are_over_the_face_and_strict_json(
    rig: Rig, certificate: Certificate, tmp_path: Path
) -> None:
    path = tmp_path / "report.json"
    write_json(path, report(rig, certificate))
    figures = json.loads(path.read_text(), parse_constant=pytest.fail)
    moved = small_capture("smile").vertices - small_capture("neutral").vertices
    expected = (1 - SHARE) * np.linalg.norm(moved[rig.model.face], axis=1).mean()
    smile = figures["expressions"]["smile"]
    assert smile["mean_mm"] == pytest.approx(expected, abs=1e-3)
    assert smile["mean_mm"] < smile["p95_mm"] < smile["max_mm"]
    on_face = np.isin(np.arange(len(moved)), rig.model.face)
    assert set(smile["regions"]) == {
        name for name, ids in rig.model.regions.items() if on_face[ids].any()
    }
    train = [figures["expressions"][name]["mean_mm"] for name in ("smile", "surprise")]
    assert figures["train_mean_mm"] == pytest.approx(np.mean(train), abs=1e-3)
    assert figures["test_mean_mm"] == figures["expressions"]["ah"]["mean_mm"]
    assert (figures["inverted"], figures["muscles"]) == (3, rig.model.muscle_count)
    one = replace(rig, expressions=rig.expressions[:1])
    assert report(one, certificate)["test_mean_mm"] is None


def _used(skin: Surface) -> dict[str, np.ndarray]:
    return {name: np.unique(skin.faces[numbers]) for name, numbers in skin_parts(skin).items()}


SMALL_PARTS = {
    "skin": (0, 4359),
    "mouth": (4360, 4585),
    "teeth": (4586, 4721),
    "eyes": (4722, 4865),
}
"""Part -> its first and last vertex: the built-in topology has its parts one after the other."""


def test_parts_of_the_built_in_topology(model: SubjectModel) -> None:
    used = {name: (ids.min(), ids.max()) for name, ids in _used(model.skin).items()}
    assert used == SMALL_PARTS


def test_parts_of_the_ict_topology() -> None:
    used = _used(ict_capture("neutral"))
    assert used["skin"].max() == 14061
    assert (used["eyes"].min(), used["eyes"].max()) == (21451, 24590)
    assert (used["teeth"].min(), used["teeth"].max()) == (17039, 21450)
    assert used["lashes"].min() == 24591


def test_glb_holds_the_expressions_and_reads_back(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "rig.glb"
    glb.write(rig, path)
    assert validate_glb(path, NAMES) == []
    skin = rig.model.skin
    np.testing.assert_allclose(
        read_registered(path, skin.faces, len(skin.vertices)).vertices, skin.vertices, atol=1e-4
    )
    document = pygltflib.GLTF2().load(str(path))
    mesh = document.meshes[0]
    assert mesh.extras["targetNames"] == NAMES
    for number, fit in enumerate(rig.expressions):
        change = _sparse(document, mesh.primitives[0].targets[number]["POSITION"])
        np.testing.assert_allclose(
            skin.vertices + 1000 * change, fit.skin, atol=2e-3, err_msg=fit.name
        )
    triangles = sum(document.accessors[part.indices].count for part in mesh.primitives) // 3
    assert triangles == len(skin.faces)
    weights = document.accessors[document.animations[0].samplers[0].output]
    assert weights.count == (3 * len(NAMES) + 1) * len(NAMES)


def _sparse(document: pygltflib.GLTF2, number: int) -> np.ndarray:
    accessor = document.accessors[number]
    blob = document.binary_blob()

    def stored(view: int, kind: str) -> np.ndarray:
        place = document.bufferViews[view]
        return np.frombuffer(blob[place.byteOffset : place.byteOffset + place.byteLength], kind)

    values = np.zeros((accessor.count, 3), "<f4")
    rows = stored(accessor.sparse.indices.bufferView, "<u2")
    values[rows] = stored(accessor.sparse.values.bufferView, "<f4").reshape(-1, 3)
    return values


def test_a_broken_glb_is_noticed(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "rig.glb"
    glb.write(rig, path)
    assert validate_glb(path, [*NAMES, "more"]) != []
    content = bytearray(path.read_bytes())
    start = 28 + int.from_bytes(content[12:16], "little")
    content[start : start + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(content)
    assert any("not finite" in fault for fault in validate_glb(path, NAMES))


def test_the_table_says_what_the_arrays_say(rig: Rig, tmp_path: Path) -> None:
    path = tmp_path / "activations.csv"
    rig = replace(rig, model=replace(rig.model, fibres=None))
    certificate = certify(Face(rig.model), rig, {"rounds": 2})
    figures = report(rig, certificate)
    csv_exporter.write(replace(rig, figures=figures), path)
    rows = list(csv.DictReader(path.open(newline="", encoding="utf-8")))
    assert len(rows) == len(NAMES) * rig.model.muscle_count
    surprise = rig.expressions[1]
    row = rows[rig.model.muscle_count + 4]
    muscle = rig.model.muscle_names[4]
    assert (row["expression"], row["role"], row["muscle"]) == ("surprise", "train", muscle)
    stored = [float(row[entry]) for entry in ("xx", "xy", "xz", "yy", "yz", "zz")]
    np.testing.assert_allclose(stored, surprise.activations[4], atol=1e-6)
    np.testing.assert_allclose(
        [float(row[f"jaw.{k}"]) for k in range(1, 6)], surprise.jaw, atol=1e-6
    )
    assert row["contraction"] == row["fibres"] == ""  # this model has no fibres
    assert list(row)[:4] == ["expression", "role", "muscle", "contraction"]


@pytest.mark.long
def test_write_rig_writes_every_file(rig: Rig, certificate: Certificate, tmp_path: Path) -> None:
    one = replace(rig, expressions=rig.expressions[:1])
    written = write_rig(one, certificate, tmp_path / "rig")
    names = ["rig.glb", "activations.npz", "activations.csv", "muscle_weights.npz", "view.bin"]
    names += ["inside.bin", "report.json", "report.html", "fit_smile.png", "rig.npz"]
    names += ["rig.usdc"] if find_spec("pxr") else []
    assert sorted(path.name for path in written) == sorted(names)
    assert all(path.stat().st_size > 500 for path in written)
