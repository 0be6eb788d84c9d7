"""What a page reads of a rig is the rig, within half precision, and fits together."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.anatomy.embedding import tet_binder
from solver.fitting.face import Face, Pose
from solver.mechanics.boundary import move_jaw
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import inside as inside_exporter
from solver.rig.exporters import view as view_exporter
from solver.rig.exporters.inside import NO_MUSCLE
from solver.rig.report import report
from solver.rig.report.certificate import certify
from solver.storage import Archive, read_container
from solver.surface import Surface
from tests.fixtures import fixture_model
from tests.solver.block import block_model, grid

JAW = np.array([0.2, 0.05, 0.5, -1.0, 2.0])
HIDDEN = [0, 3]


@pytest.fixture(scope="module")
def rig() -> Rig:
    """A simulated expression of a block of flesh, and one carried from a rig without flesh."""
    box, _ = grid((1, 1, 1), (10.0, 10.0, 10.0))
    cube = Surface(box, np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6]]))
    model = replace(
        block_model(),
        bones={"cranium": cube, "mandible": cube.with_vertices(box - 20.0)},
        muscles={"right": cube.with_vertices(box + np.array([30.0, 10.0, 4.0]))},
    )
    face = Face(model)
    rest = face.rest_pose()
    contracted = rest.a + np.array([-0.25, 0.05, 0.0, 0.15, 0.0, 0.15])
    state = face.continuation(face.rest, Pose(contracted, JAW))
    skin = face.whole_skin(state.x, JAW)
    target = skin + 0.25
    target[HIDDEN] = np.nan
    error = np.full(len(skin), np.nan)
    error[model.face] = np.linalg.norm(target - skin, axis=1)[model.face]
    fit = ExpressionFit(
        "smile", "train", contracted, JAW, skin, target, error, 0, 5, 1.0, 0.1, x=state.x
    )
    carried = replace(fit, name="old", x=None)
    return Rig(model, model.weights, (fit, carried), {})


@pytest.fixture(scope="module")
def view(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Archive:
    path = tmp_path_factory.mktemp("view") / "view.bin"
    figures = report(rig, certify(Face(rig.model), rig, {}))
    view_exporter.write(replace(rig, figures=figures), path)
    return read_container(path)


@pytest.fixture(scope="module")
def inside(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Archive:
    path = tmp_path_factory.mktemp("inside") / "inside.bin"
    inside_exporter.write(rig, path)
    return read_container(path)


def test_the_view_shows_the_fit_the_scan_and_the_distance(rig: Rig, view: Archive) -> None:
    fit = rig.expressions[0]
    arrays = view.arrays
    skin = arrays["neutral"] + arrays["skin/0"].astype(np.float32)
    np.testing.assert_allclose(skin, fit.skin, atol=0.004)
    scan = arrays["neutral"] + arrays["scan/0"].astype(np.float32)
    np.testing.assert_allclose(scan, fit.target, atol=0.004)  # NaN where nothing was seen
    assert np.isnan(arrays["error/0"][HIDDEN]).all()
    np.testing.assert_allclose(arrays["error/0"], fit.error_mm, atol=1e-3)
    np.testing.assert_array_equal(arrays["faces"], rig.model.skin.faces)
    told = view.header["expressions"][0]
    assert (told["name"], view.header["muscles"]) == ("smile", ["left", "right"])
    assert told["mean_mm"] == pytest.approx(0.25 * math.sqrt(3.0), abs=1e-3)
    assert told["mean_mm"] <= told["p95_mm"] <= told["max_mm"]
    assert arrays["activation"].shape == (2, 2)


def test_the_flesh_moves_as_it_was_solved(rig: Rig, inside: Archive) -> None:
    arrays = inside.arrays
    at = arrays["rest"] + arrays["at/0"].astype(np.float32)
    np.testing.assert_allclose(at, rig.expressions[0].x, atol=0.004)
    assert "at/1" not in arrays
    np.testing.assert_array_equal(arrays["tets"], rig.model.tets)
    main = arrays["main_muscle"]
    centre = rig.model.rest[rig.model.tets].mean(axis=1)[:, 0]
    assert set(main) == {0, 1, NO_MUSCLE}
    assert centre[main == 0].max() < centre[main == 1].min()


def test_bones_move_with_the_jaw_or_stay(rig: Rig, inside: Archive) -> None:
    assert inside.header["bones"] == [
        {"name": "cranium", "moves_with": "skull"},
        {"name": "mandible", "moves_with": "jaw"},
    ]
    points = inside.arrays["bone/1/vertices"]
    motion = inside.arrays["jaw"][0]
    moved = points @ motion[:3, :3].T + motion[:3, 3]
    np.testing.assert_allclose(moved, move_jaw(rig.model.jaw, points, JAW), atol=1e-4)


def test_muscles_hang_in_the_flesh(rig: Rig, inside: Archive) -> None:
    arrays = inside.arrays
    assert arrays["muscle/0/vertices"].shape == (0, 3)  # this muscle has no surface
    vertices = rig.model.muscles["right"].vertices
    np.testing.assert_allclose(arrays["muscle/1/vertices"], vertices)
    corners = arrays["tets"][arrays["muscle/1/tet"]]
    place = np.einsum("nk,nkd->nd", arrays["muscle/1/weights"], arrays["rest"][corners])
    np.testing.assert_allclose(place, vertices, atol=1e-4)


def test_points_outside_follow_the_nearest_point_of_the_flesh() -> None:
    vertices, tets = grid((2, 2, 2), (10.0, 10.0, 10.0))
    points = np.array([[3.0, 4.0, 12.0], [3.0, 4.0, 9.0]])
    tet, weights = tet_binder(vertices, tets)(points)
    place = np.einsum("nk,nkd->nd", weights, vertices[tets[tet]])
    np.testing.assert_allclose(place, [[3.0, 4.0, 10.0], [3.0, 4.0, 9.0]], atol=1e-9)
    assert weights.min() >= -1e-9


def test_the_same_rig_gives_the_same_bytes(rig: Rig, tmp_path: Path) -> None:
    one = tmp_path / "one.bin"
    two = tmp_path / "two.bin"
    inside_exporter.write(rig, one)
    inside_exporter.write(rig, two)
    assert one.read_bytes() == two.read_bytes()


def test_a_whole_face_takes_little_time_and_space(rig: Rig, tmp_path: Path) -> None:
    model = fixture_model("neutral")
    skin = model.skin.vertices
    fit = replace(
        rig.expressions[0],
        skin=skin + 1.0,
        target=skin + 1.1,
        error_mm=np.full(len(skin), 0.1),
        x=model.rest + 1.0,
        activations=np.zeros((model.muscle_count, 6)),
    )
    fits = tuple(replace(fit, name=f"e{k}") for k in range(13))
    whole = Rig(model, model.weights, fits, {})
    figures = dict.fromkeys(("mean_mm", "p95_mm", "max_mm"), 0.1)
    muscles = {name: {"fibres": None} for name in model.muscle_names}
    told = {"expressions": {fit.name: {**figures, "muscles": muscles} for fit in fits}}
    start = time.process_time()
    view_exporter.write(replace(whole, figures=told), tmp_path / "view.bin")
    inside_exporter.write(whole, tmp_path / "inside.bin")
    assert time.process_time() - start < 2.0
    view, inside = ((tmp_path / name).stat().st_size for name in ("view.bin", "inside.bin"))
    triangles = 12 * len(model.skin.faces)
    assert view < len(skin) * (12 + 13 * 14) + triangles + 20_000
    assert inside < 8e6
