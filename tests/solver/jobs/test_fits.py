"""The jobs that fit: their solvers, and that bad input is told and loses nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError, SolveError
from solver.fitting import fallback, geometry
from solver.fitting.drives.fibre_contraction import FibreContraction
from solver.fitting.face import Face, Pose
from solver.fitting.reference import NotConvergedError, ReferenceSolution
from solver.jobs import run_job
from solver.mechanics.boundary import FreeJaw
from solver.mechanics.jaw_tracks import JawTracks
from solver.meshio.obj import write_obj
from solver.meshio.registered import read_registered
from solver.model import CondyleTracks
from solver.progress import Step
from solver.rig import Rig
from solver.surface import Floats, Surface
from tests.solver.block import head_block

pytestmark = pytest.mark.long

MODEL = head_block((7, 5, 1))


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model, a rig of it, two simulated expressions, and one of them with a bump."""
    folder = tmp_path_factory.mktemp("subject")
    MODEL.save(folder / "model.npz")
    Rig(MODEL, MODEL.weights, ()).save(folder / "rig.npz")
    face = Face(MODEL)
    rest = face.rest
    for name, stretch, hinge in (("wide", (0.8, 0.95), 0.06), ("narrow", (0.95, 0.8), 0.02)):
        a = np.array([[s, 0.02, 0.0, 1 / np.sqrt(s), 0.0, 1 / np.sqrt(s)] for s in stretch])
        state = face.continuation(rest, Pose(a, np.array([hinge, 0.0, 0.0, 0.0, 0.0])))
        write(folder / f"{name}.obj", face.face_points(state.x))
        if name == "wide":
            bump = face.face_points(state.x)
            bump[[26, 27, 32, 33], 2] += [12.0, 9.0, 9.0, 7.0]
            write(folder / "bump.obj", bump)
    return folder


def write(path: Path, vertices: Floats) -> Path:
    write_obj(path, Surface(vertices, MODEL.skin.faces))
    return path


def activations(
    files: Path, out: Path, *names: str, **more: Any
) -> tuple[dict[str, Any], list[Step]]:
    """Fit the expressions freely; return the report and the steps that were told."""
    steps: list[Step] = []
    scans = {name: files / f"{name}.obj" for name in names}
    given = {"rig": files / "rig.npz", **more}
    given["options"] = {"controls": "free", **given.get("options", {})}
    run_job("fit_activations", out, captures=scans, progress=steps.append, **given)
    return json.loads((out / "report.json").read_text()), steps


def warnings(steps: list[Step]) -> list[str | None]:
    """Return the warnings but that the block has no expressions."""
    messages = [step.message for step in steps if step.phase == "warning"]
    assert "keeps no expressions" in str(messages[0])
    return messages[1:]


def test_a_rig_of_another_drive_is_refused_unless_controls_are_given(
    files: Path, tmp_path: Path
) -> None:
    fibred = replace(MODEL, fibres=np.tile([1.0, 0.0, 0.0], (MODEL.weights.nnz, 1)))
    rig = tmp_path / "rig.npz"
    Rig(fibred, fibred.weights, (), drive=FibreContraction(fibred)).save(rig)
    with pytest.raises(InputError, match="driven by contraction") as caught:
        activations(files, tmp_path / "out", "wide", rig=rig, options={"controls": None})
    assert caught.value.code == "rig.drive"
    report, _ = activations(files, tmp_path / "out", "wide", rig=rig)
    assert report["settings"]["controls"] == "free"


def test_an_artifact_is_named_with_region_and_vertex(files: Path, tmp_path: Path) -> None:
    report, steps = activations(files, tmp_path, "bump", "narrow")
    (warning,) = report["expressions"]["bump"]["warnings"]
    assert warning["code"] == "fit.inflated"
    assert (warning["vertex"], warning["region"]) == (26, "left")
    assert 4.0 < warning["mm"] < 12.0
    assert warnings(steps) == [warning["message"]]
    assert report["expressions"]["narrow"]["warnings"] == []
    assert report["expressions"]["narrow"]["status"] == "converged"
    # a rig that carries the expression over still says so
    again, _ = activations(files, tmp_path / "next", "wide", rig=tmp_path / "rig.npz")
    assert again["expressions"]["bump"]["warnings"] == [warning]


def test_admissible_controls_keep_muscles_to_what_they_can_do(files: Path, tmp_path: Path) -> None:
    face = Face(MODEL)
    swollen = np.tile([1.7, 0.0, 0.0, 1.4, 0.0, 1.0], (2, 1))
    state = face.continuation(face.rest, Pose(swollen, np.array([0.04, 0.0, 0.0, -0.5, -0.5])))
    scan = {"swollen": write(tmp_path / "swollen.obj", face.face_points(state.x))}
    fibres = np.where(MODEL.weights.indices[:, None] > 0, [1.0, 0.0, 0.0], 0.0)
    jaw = replace(MODEL.jaw, tracks=CondyleTracks(0.6, 60.0, 2.0, 0.3))
    replace(MODEL, fibres=fibres, jaw=jaw).save(tmp_path / "model.npz")
    beyond = {}
    for controls in ("free", "admissible"):
        out = tmp_path / controls
        options = {"controls": controls, "rounds": 3}
        model = {"model": tmp_path / "model.npz"}
        run_job("fit_geometry", out, options=options, captures=scan, **model)
        report = json.loads((out / "report.json").read_text())
        assert report["settings"]["controls"] == controls
        rounds = report["rounds"]
        assert [each["number"] for each in rounds[:3]] == [1, 2, 3]
        loosened = [each["loosened"] for each in rounds]
        assert loosened[:3] == [None] * 3
        assert (loosened[-1] == 0.0) == (controls == "admissible")
        for each in rounds:
            assert each["mean_mm"] > 0.0 < each["objective"]
            assert 0.0 <= each["seconds"] < report["seconds"]["geometry"]
        muscles = report["expressions"]["swollen"]["muscles"]
        beyond[controls] = [name for name, found in muscles.items() if found["faults"]]
        volume = {name: found["volume"] for name, found in muscles.items()}
        (fit,) = Rig.load({"rig": out / "rig.npz"}).expressions
        off_track = JawTracks.of(jaw).departure(FreeJaw(jaw).matrix(fit.jaw))
        if controls == "admissible":
            assert all(0.9 < each <= 1.1 for each in volume.values())
            assert off_track < 1e-6
        else:
            assert off_track > 0.05
    assert beyond == {"free": ["left", "right"], "admissible": []}
    # the less plausible, the nearer the skin and the larger the muscles
    means = []
    volumes = []
    for plausibility in (1.0, 0.5, 0.0):
        out = tmp_path / f"by_{plausibility}"
        options = {"controls": "admissible", "plausibility": plausibility}
        run_job(
            "fit_activations",
            out,
            options=options,
            captures=scan,
            rig=tmp_path / "free" / "rig.npz",
        )
        report = json.loads((out / "report.json").read_text())
        # those of the fit that S is of
        assert len(report["rounds"]) == 3
        found = report["expressions"]["swollen"]
        means.append(found["mean_mm"])
        volumes.append(max(each["volume"] for each in found["muscles"].values()))
        limits = report["settings"]["limits"]
        assert volumes[-1] <= limits["volume"]
    assert means == sorted(means, reverse=True)
    assert volumes == sorted(volumes)


@pytest.mark.parametrize("kind", ["fit_activations", "fit_geometry"])
def test_known_activations_are_kept_to_and_disagreement_is_told(
    kind: str, files: Path, tmp_path: Path
) -> None:
    """The right muscle of ``narrow`` contracts by 0.2, of ``wide`` by 0.05: that is known wrong."""
    fibres = np.where(MODEL.weights.indices[:, None] > 0, [1.0, 0.0, 0.0], 0.0)
    model = replace(MODEL, fibres=fibres)
    Rig(model, model.weights, ()).save(tmp_path / "rig.npz")
    model.save(tmp_path / "model.npz")
    table = tmp_path / "emg.csv"
    table.write_text("muscle,expression,value,sd\nright,narrow,0.2,0.05\nright,wide,0.4,0.02\n")
    read = "rig" if kind == "fit_activations" else "model"
    given = {read: tmp_path / f"{read}.npz", "activations": table}
    scans = {name: files / f"{name}.obj" for name in ("wide", "narrow")}
    options = {"controls": "free"} | ({"rounds": 2} if read == "model" else {})
    run_job(kind, tmp_path / "out", captures=scans, options=options, **given)
    report = json.loads((tmp_path / "out" / "report.json").read_text())["expressions"]
    (agreed,), (wrong,) = (report[name]["known"] for name in ("narrow", "wide"))
    assert (agreed["muscle"], agreed["known"], agreed["sd"]) == ("right", 0.2, 0.05)
    assert abs(agreed["off_sd"]) < 1.0
    # a table that is sure of what the skin denies
    assert wrong["off_sd"] < -2.0
    (told,) = (each for each in report["wide"]["warnings"] if "disagree" in each["code"])
    assert told["code"] == "activations.disagree"
    assert told["muscle"] == "right"
    assert not any("disagree" in each["code"] for each in report["narrow"]["warnings"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('class="known"') == 2
    rig = Rig.load(tmp_path / "out" / "rig.npz")
    assert rig.expression("wide").known[0].as_dict() == wrong
    table.write_text("muscle,expression,value,sd\nright,grin,0.2,0.05\n")
    with pytest.raises(InputError, match="no expression grin") as refused:
        run_job(kind, tmp_path / "out", captures=scans, options=options, **given)
    assert refused.value.code == "activations.expression"


def fail(*_args: object, **_more: object) -> None:
    raise SolveError("solve.no_convergence", "the fitted face does not come to rest")


def test_information_is_kept_while_s_and_its_scans_are(files: Path, tmp_path: Path) -> None:
    activations(files, tmp_path, "narrow")
    [fit] = Rig.load(tmp_path / "rig.npz").expressions
    known = {"scans": 1, "muscles": {"left": 0.25, "right": 0.5}, "confused": []}
    known["confused"] = [{"muscles": ["left", "right"], "correlation": -0.9}]
    parent = Rig(
        MODEL, MODEL.weights, (replace(fit, role="train"),), figures={"information": known}
    )
    parent.save(tmp_path / "parent.npz")
    more = {"rig": tmp_path / "parent.npz"}
    kept, _ = activations(files, tmp_path / "kept", "wide", **more)
    assert kept["information"] == known
    # the training scan is no more: its expression was fitted anew
    replaced, _ = activations(files, tmp_path / "replaced", "narrow", **more)
    assert replaced["information"] is None


def test_what_neither_solver_can_fit_costs_only_itself(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """IPOPT ends with numbers that are none; the other expression is kept."""
    real = fallback.reference.activations
    calls = []

    def broken(face: Face, *args: Any, **more: Any) -> ReferenceSolution:
        calls.append(face)
        if len(calls) <= len(fallback.FallbackOptions.heavier):
            x = np.full_like(MODEL.rest, np.nan)
            last = ReferenceSolution(np.nan, 3, np.nan, "", face.rest_pose(), x)
            raise NotConvergedError("Invalid number detected", last)
        return real(face, *args, **more)

    monkeypatch.setattr(fallback.activation, "fit", fail)
    monkeypatch.setattr(fallback.reference, "activations", broken)
    report, steps = activations(files, tmp_path / "both", "wide", "narrow")
    lost = report["expressions"]["wide"]
    kept = report["expressions"]["narrow"]
    assert (lost["solver"], lost["status"]) == ("ipopt", "failed")
    assert [each["code"] for each in lost["warnings"]][:2] == ["solve.fallback", "ipopt.failed"]
    assert (kept["solver"], kept["status"]) == ("ipopt", "converged")
    assert [each["code"] for each in kept["warnings"]] == ["solve.fallback"]
    assert "does not come to rest" in kept["warnings"][0]["message"]
    told = [each["message"] for each in (*lost["warnings"], *kept["warnings"])]
    assert warnings(steps) == told
    calls.clear()
    with pytest.raises(SolveError, match=r"wide: .*Invalid number") as caught:
        activations(files, tmp_path / "none", "wide")
    assert caught.value.code == "fit.failed"


def test_geometry_by_ipopt_from_one_target(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans = {"wide": files / "wide.obj"}
    options = {"solver": "ipopt", "rounds": 2}
    model = files / "model.npz"
    run_job("fit_geometry", tmp_path / "rig", options=options, captures=scans, model=model)
    report = json.loads((tmp_path / "rig" / "report.json").read_text())
    assert report["settings"]["solver"] == "ipopt"
    assert [warning["code"] for warning in report["warnings"]] == [
        "recruitment.none",
        "fit.one_target",
    ]
    assert report["expressions"]["wide"]["mean_mm"] < 0.1
    assert report["inverted"] == 0
    before = tmp_path / "rig" / "rig.npz"
    after, _ = activations(files, tmp_path / "next", "narrow", rig=before)
    assert after["seconds"]["geometry"] == pytest.approx(report["seconds"]["geometry"], abs=2e-3)
    monkeypatch.setattr(geometry, "MOST_TETS", 400)
    scans["narrow"] = files / "narrow.obj"
    with pytest.raises(InputError, match="use solver reduced") as caught:
        run_job("fit_geometry", tmp_path / "no", options=options, captures=scans, model=model)
    assert caught.value.code == "options.too_large"


def test_a_flipped_scan_is_called_so(files: Path, tmp_path: Path) -> None:
    turned = np.array([-1.0, 1.0, 1.0]) * MODEL.skin.vertices
    scans = {"flipped": write(tmp_path / "flipped.obj", turned), "wide": files / "wide.obj"}
    given = {"rig": files / "rig.npz"}
    with pytest.raises(InputError, match=r"flipped.obj .* 180 degrees") as caught:
        run_job("fit_activations", tmp_path / "rig", captures=scans, **given)
    assert caught.value.code == "scan.misaligned"


def test_a_fit_to_planes_is_not_misled_by_vertices_that_slid(files: Path, tmp_path: Path) -> None:
    faces = MODEL.skin.faces
    count = len(MODEL.skin.vertices)
    true = read_registered(files / "narrow.obj", faces, count).vertices
    scans = {"slid": write(tmp_path / "slid.obj", true + np.array([4.0, 0.0, 0.0]))}
    given = {"rig": files / "rig.npz"}
    away = {}
    for distance in ("point", "plane"):
        out = tmp_path / distance
        options = {"distance": distance}
        run_job("fit_activations", out, options=options, captures=scans, **given)
        report = json.loads((out / "report.json").read_text())
        assert (report["settings"]["distance"], report["inverted"]) == (distance, 0)
        skin = Rig.load(out).expressions[0].skin
        away[distance] = np.linalg.norm(skin - true, axis=1).mean()
    assert away["plane"] < 1.0 < 3.0 < away["point"]


@pytest.mark.parametrize(
    ("option", "known"), [("solver", "'reduced' or 'ipopt'"), ("distance", "'point' or 'plane'")]
)
def test_an_unknown_choice_is_refused(files: Path, tmp_path: Path, option: str, known: str) -> None:
    with pytest.raises(InputError, match=f"not one of {known}") as caught:
        activations(files, tmp_path, "wide", options={option: "fast"})
    assert caught.value.code == f"options.{option}"
