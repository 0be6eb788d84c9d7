"""The job that fits weights of tracks: the systems of the rig that it leaves, and what it tells."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from solver.contact.crossing import Crossing
from solver.errors import InputError
from solver.fitting.face import Face
from solver.fitting.least_squares import LeastSquaresSolution
from solver.fitting.per_tet import tissue
from solver.jobs import run_job
from solver.meshio.registered import read_registered, write_registered
from solver.model import SubjectModel
from solver.rig import Rig, ShapeFit, TetSystem, shape_fits
from solver.rig.exporters import export_measured
from solver.similarity import small_motion
from solver.storage import read_container
from solver.surface import Floats, Surface
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.plain import PlainFace
from tests.fixtures import small_model
from tests.solver.block import head_block
from tests.solver.jobs.test_fit_photo import shapes as photo_shapes

pytestmark = pytest.mark.long

WEIGHTS = {"wide": {"aside": 0.7, "bulge": 0.4}, "full": {"bulge": 0.9}}


def block() -> SubjectModel:
    """Return a block as large as a head with fibres along x."""
    plain = head_block((7, 5, 1))
    fibres = np.where(plain.weights.indices[:, None] > 0, [1.0, 0.0, 0.0], 0.0)
    return replace(plain, fibres=fibres)


MODEL = block()


def shapes() -> dict[str, Floats]:
    """Return a skin that is drawn aside, and one that bulges."""
    skin = MODEL.skin.vertices
    middle = np.exp(-(((skin[:, :2] - [75.0, 60.0]) / 40.0) ** 2).sum(axis=1))
    aside = np.zeros_like(skin)
    bulge = np.zeros_like(skin)
    aside[:, 0] = 4.0 * middle
    bulge[:, 2] = 3.0 * middle
    return {"aside": aside, "bulge": bulge}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig of the model with one expression by muscles, its tracks, and scans that they make."""
    folder = tmp_path_factory.mktemp("subject")
    tracks = MuscleTracks.of(MODEL, shapes())
    tracks.save(folder / "tracks.npz")
    face = TrackFace(MODEL, tracks, track_potentials(MODEL))
    for name, weights in WEIGHTS.items():
        write(folder / f"{name}.ply", face.skin(face.move(face.rest(), tracks.controls(weights))))
    MODEL.save(folder / "model.npz")
    Rig(MODEL, MODEL.weights, ()).save(folder / "none.npz")
    given = {"rig": folder / "none.npz", "options": {"controls": "free"}}
    captures = {"wide": folder / "wide.ply"}
    run_job("fit_activations", folder / "rig", captures=captures, **given)
    return folder


def write(path: Path, skin: Floats, confidence: Floats | None = None) -> Path:
    seen = np.ones(len(skin)) if confidence is None else confidence
    write_registered(path, Surface(skin, MODEL.skin.faces), seen)
    return path


def fit(files: Path, out: Path, *names: str, **more: Any) -> tuple[Rig, dict[str, Any]]:
    """Fit scans by name; return the rig that is left, and its report."""
    captures = {name: files / f"{name}.ply" for name in names}
    given = {"rig": files / "rig" / "rig.npz", "tracks": files / "tracks.npz", **more}
    run_job("fit_tracks", out, **{"captures": captures, **given})
    return Rig.load(out / "rig.npz"), json.loads((out / "report.json").read_text())


def test_weights_stand_beside_the_muscles(files: Path, tmp_path: Path) -> None:
    options = {"plain_shapes": True, "w_w": 1e-8}
    rig, report = fit(files, tmp_path, "wide", "full", options=options)
    assert [fit.name for fit in rig.expressions] == ["wide"]
    assert set(rig.systems) == {"T", "B"}
    by_tracks = rig.systems["T"]
    plain = rig.systems["B"]
    assert by_tracks.shapes == plain.shapes == ("aside", "bulge")
    for fitted in by_tracks.expressions:
        expected = [WEIGHTS[fitted.name].get(shape, 0.0) for shape in by_tracks.shapes]
        np.testing.assert_allclose(fitted.weights, expected, atol=0.05)
        assert (fitted.inverted, fitted.status, fitted.role) == (0, "converged", "test")
        assert np.nanmean(fitted.error_mm) < 0.05
        assert fitted.round_trip is not None
        assert fitted.round_trip.skin_max_mm < 0.05
        assert fitted.x is not None
        assert fitted.lengths.shape == (MODEL.muscle_count,)
    told = report["systems"]
    assert set(told["wide"]) == {"S", "T", "B"}
    assert set(told["full"]) == {"T", "B"}
    assert told["full"]["T"]["controls_used"] == 1
    assert told["full"]["T"]["controls"] == 2
    # flesh is what made these scans: the sum of shapes is no better
    assert told["wide"]["T"]["mean_mm"] < told["wide"]["B"]["mean_mm"]
    assert report["settings"]["tracks"]["w_w"] == 1e-8
    assert "system" in export_measured(rig, "systems", tmp_path / "again.glb").figures
    assert (tmp_path / "systems.glb").is_file()
    shown = read_container(tmp_path / "view_T.bin").header["expressions"]
    assert [each["name"] for each in shown] == ["wide", "full"]
    assert "Systems side by side" in (tmp_path / "report.html").read_text()


def test_later_fits_carry_the_others_over(files: Path, tmp_path: Path) -> None:
    fit(files, tmp_path / "one", "wide")
    first = tmp_path / "one" / "rig.npz"
    rig, _ = fit(files, tmp_path / "two", "full", rig=first)
    assert [fit.name for fit in rig.systems["T"].expressions] == ["wide", "full"]
    # a fit of muscles to the same scan keeps what tracks made of it, one to another does not
    for scan, kept in (("wide", ["wide", "full"]), ("full", ["full"])):
        out = tmp_path / scan
        captures = {"wide": files / f"{scan}.ply"}
        options = {"controls": "free"}
        given = {"rig": tmp_path / "two" / "rig.npz", "options": options}
        run_job("fit_activations", out, captures=captures, **given)
        again = Rig.load(out / "rig.npz")
        assert [fit.name for fit in again.systems["T"].expressions] == kept


def test_muscles_are_fitted_to_what_the_rig_does_not_know(files: Path, tmp_path: Path) -> None:
    rig, report = fit(files, tmp_path, "wide", "full", options={"muscles": True})
    before = Rig.load(files / "rig" / "rig.npz")
    assert [fit.name for fit in rig.expressions] == ["wide", "full"]
    np.testing.assert_array_equal(rig.expressions[0].activations, before.expressions[0].activations)
    assert set(report["systems"]["full"]) == {"S", "T"}


def test_single_tets_stand_beside_the_others(files: Path, tmp_path: Path) -> None:
    rig, report = fit(files, tmp_path, "wide", options={"per_tet": True})
    assert set(rig.systems) == {"T", "P"}
    system = rig.systems["P"]
    assert isinstance(system, TetSystem)
    (found,) = system.expressions
    assert found.tet_activations.shape == (len(system.tets), 6)
    told = report["systems"]["wide"]["P"]
    assert told["mean_mm"] < 0.3 < np.linalg.norm(found.target - MODEL.skin.vertices, axis=1).max()
    assert 0 < told["controls_used"] <= told["controls"] == len(system.tets)
    # what muscles do is the mean of their tets
    weight = tissue.of_face(Face(MODEL)).fractions[:, [0]].toarray()
    mean = (weight * found.tet_activations).sum(axis=0) / weight.sum()
    np.testing.assert_allclose(found.activations[0], mean, atol=1e-6)
    assert found.round_trip is not None
    assert found.round_trip.skin_max_mm < 0.05
    # with further fits of muscles they are carried over and shown
    again = tmp_path / "again"
    given = {"rig": tmp_path / "rig.npz", "options": {"controls": "free"}}
    run_job("fit_activations", again, captures={"full": files / "full.ply"}, **given)
    assert set(Rig.load(again).systems) == {"T", "P"}
    assert {each.name for each in again.iterdir()} >= {"systems.glb", "view_T.bin", "view_P.bin"}


def test_bounds_are_kept_unless_weights_are_free(files: Path, tmp_path: Path) -> None:
    skin = MODEL.skin.vertices - 0.5 * shapes()["aside"]
    captures = {"back": write(tmp_path / "back.ply", skin)}
    found = {}
    for bounds in ("unit", "free"):
        options = {"bounds": bounds, "w_w": 1e-8}
        rig, _ = fit(files, tmp_path / bounds, options=options, captures=captures)
        found[bounds] = rig.systems["T"].expressions[0].weights[0]
    assert found["unit"] == 0.0
    assert found["free"] < -0.3


def test_what_is_odd_about_a_scan_is_told_with_its_place(files: Path, tmp_path: Path) -> None:
    scan = MODEL.skin.vertices + 0.5 * shapes()["bulge"]
    turn = np.deg2rad(8.0)
    turned = scan @ np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    captures = {
        "wide": write(tmp_path / "wide.ply", scan),
        "turned": write(tmp_path / "turned.ply", turned),
    }
    _, report = fit(files, tmp_path / "out", captures=captures)
    codes = {
        name: {each["code"] for each in found["T"]["warnings"]}
        for name, found in report["systems"].items()
    }
    assert "target.other" in codes["wide"]
    assert "target.turned" in codes["turned"]


def test_a_turned_head_is_placed_and_kept(tmp_path: Path) -> None:
    model = small_model()
    tracks = MuscleTracks.of(model, photo_shapes())
    tracks.save(tmp_path / "tracks.npz")
    Rig(model, model.weights, ()).save(tmp_path / "rig.npz")
    face = PlainFace(model, tracks)
    skin = face.skin(face.move(face.rest(), tracks.controls({"mouthSmileLeft": 0.8})))
    motion = small_motion(np.array([0.0, 0.0, np.deg2rad(8.0), 3.0, -1.0, 2.0]))
    moved = model.skin.with_vertices(motion(skin))
    write_registered(tmp_path / "smile.ply", moved, np.ones(len(skin)))
    options = {"head": "placed", "plain_shapes": True}
    rig, report = fit(tmp_path, tmp_path, "smile", rig=tmp_path / "rig.npz", options=options)
    codes = {each["code"] for each in report["systems"]["smile"]["T"]["warnings"]}
    assert "target.turned" not in codes
    for system, apart in (("T", 0.1), ("B", 1e-3)):
        (found,) = rig.systems[system].expressions
        assert isinstance(found, ShapeFit)
        np.testing.assert_allclose(found.head[:3], motion.twist[:3], atol=0.1 * apart)
        np.testing.assert_allclose(motion(found.target), moved.vertices, atol=10.0 * apart)
        scan = read_registered(tmp_path / "smile.ply", model.skin.faces, len(skin))
        assert found.is_of(scan.vertices)


def test_lips_of_a_scan_that_cross_are_told(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, _ = fit(files, tmp_path, "wide")
    found = [Crossing(depth, 7, None, None, None) for depth in (3.0, 0.1)]
    monkeypatch.setattr(shape_fits.Mouth, "of", lambda _: SimpleNamespace(skin=np.arange(4)))
    monkeypatch.setattr(shape_fits, "crossing", lambda *_: found.pop(0))
    (notice,) = shape_fits.find_crossed(MODEL, rig.systems["T"].expressions[0])
    assert (notice.code, notice.context["vertex"], notice.context["mm"]) == ("target.crossed", 7, 3)
    assert "cross by 3.0 mm at vertex 7; in the fit they cross by 0.10 mm" in notice.message
    assert "mm off the scan" in notice.message


def test_what_cannot_be_used_is_refused(files: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.npz"
    moved = replace(MODEL, rest=MODEL.rest * 1.001)
    MuscleTracks.of(moved, shapes()).save(other)
    with pytest.raises(InputError) as error:
        fit(files, tmp_path / "a", "wide", tracks=other)
    assert error.value.code == "tracks.model"
    with pytest.raises(InputError) as error:
        fit(files, tmp_path / "b", "wide", tracks=None)
    assert error.value.code == "job.missing"
    small = Surface(MODEL.skin.vertices[:-1], MODEL.skin.faces[:4])
    write_registered(tmp_path / "small.ply", small, np.ones(len(small.vertices)))
    with pytest.raises(InputError) as error:
        fit(files, tmp_path / "c", captures={"small": tmp_path / "small.ply"})
    assert error.value.code.startswith("scan.")


def test_a_scan_that_the_flesh_finds_no_way_to_stays_at_rest(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = shape_fits.fit
    calls = []

    def fails_once(*given: Any, **more: Any) -> LeastSquaresSolution[Any]:
        calls.append(None)
        if len(calls) == 1:
            raise np.linalg.LinAlgError("no way")
        return real(*given, **more)

    monkeypatch.setattr(shape_fits, "fit", fails_once)
    rig, report = fit(files, tmp_path, "wide", "full")
    first, second = rig.systems["T"].expressions
    assert (first.status, second.status) == ("failed", "converged")
    assert not first.weights.any()
    assert "solve.failed" in {each["code"] for each in report["systems"]["wide"]["T"]["warnings"]}
