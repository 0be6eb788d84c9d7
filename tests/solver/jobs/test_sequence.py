"""A simulated performance of a block of flesh is fitted back, whole, in parts and in motion."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from solver.errors import InputError, SolveError
from solver.fitting.drives.admissible import Admissible, limits_by_plausibility
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, HeadAndFace, SeenPoints, stillness
from solver.fitting.tracking.frame_solver import FrameSolver
from solver.jobs import run_job
from solver.mechanics.equilibrium import CorrectorOptions
from solver.progress import Step
from solver.rig import Rig
from solver.rig.frames import ChunkOptions, read_frames
from solver.rig.frames.animation_gltf import SEQUENCE_BASIS
from solver.rig.frames.read_back import LIMIT_MM
from tests.fixtures import fixture_model
from tests.solver.block import block_model
from tests.solver.glb import shown_skins
from tests.solver.simulation.test_fibres import fibred_block

pytestmark = pytest.mark.long

FRAMES = 8
MODEL = block_model()
JAW = np.array([0.08, 0.0, 0.0, 0.5, 0.0])
CONTRACTED = np.array([-0.25, 0.05, 0.0, 0.15, 0.0, 0.15])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig and a performance: the muscles contract in turns while the jaw opens."""
    folder = tmp_path_factory.mktemp("take")
    Rig(MODEL, MODEL.weights, ()).save(folder / "rig.npz")
    face = Face(MODEL)
    rest = face.rest_pose()
    state = face.rest
    frames = []
    for number in range(FRAMES):
        share = np.array([np.sin(0.4 * number), np.sin(0.3 * number)])
        pose = Pose(rest.a + share[:, None] * CONTRACTED, JAW * np.sin(0.4 * number))
        state = face.continuation(state, pose)
        frames.append(face.face_points(state.x))
    np.save(folder / "take.npy", frames)
    return folder


def fit(files: Path, out: Path, take: str = "take.npy", *, resume: bool = False, **options: object):
    return run_job("fit_sequence", out, resume=resume, options=options, **inputs_of(files, take))


def inputs_of(files: Path, take: str = "take.npy") -> dict[str, Path]:
    return {"rig": files / "rig.npz", "performance": files / take}


def test_a_simulated_performance_is_followed(files: Path, tmp_path: Path) -> None:
    fit(files, tmp_path, fps=25.0)
    report = json.loads((tmp_path / "sequence.json").read_text())
    assert (report["frames"], report["fitted"], report["inverted"]) == (FRAMES, FRAMES, 0)
    assert report["median_mm"] < 0.02
    files = {"sequence.glb", "sequence.npz", "activations.csv"}
    assert files <= set(report["files"]) <= files | {"sequence.usdc"}
    assert report["files"]["activations.csv"]["max_activation"] < 1e-6
    assert 0.0 < report["files"]["sequence.glb"]["max_mm"] < LIMIT_MM
    with np.load(tmp_path / "sequence.npz") as found:
        assert found["activations"].shape == (FRAMES, 2, 6)
        np.testing.assert_allclose(found["time"], np.arange(FRAMES) / 25.0)
        angle = JAW[0] * np.sin(0.4 * np.arange(FRAMES))
        np.testing.assert_allclose(found["jaw"][:, 0], angle, atol=0.005)
        activations = found["activations"]
    rows = list(csv.DictReader((tmp_path / "activations.csv").open()))
    assert float(rows[3]["right.xx"]) == pytest.approx(activations[3, 1, 0], abs=1e-6)


def test_frames_are_there_before_the_end_and_a_fit_goes_on_after_them(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.jobs.sequences.FrameFitter.chunks", ChunkOptions(frames=2))
    fit(files, tmp_path / "whole", step=2)

    class DiedError(Exception):
        pass

    def die(step: Step) -> None:
        if step.message == "frame 3 of 4":
            raise DiedError

    with pytest.raises(DiedError):
        run_job(
            "fit_sequence",
            tmp_path / "parts",
            options={"step": 2},
            progress=die,
            **inputs_of(files),
        )
    assert [frame.frame for frame in read_frames(tmp_path / "parts" / "frames", 2)] == [0, 2, 4]
    fit(files, tmp_path / "parts", resume=True, step=2)
    whole, parts = (np.load(tmp_path / name / "sequence.npz") for name in ("whole", "parts"))
    assert parts["frame"].tolist() == [0, 2, 4, 6]
    np.testing.assert_array_equal(whole["activations"][:3], parts["activations"][:3])
    np.testing.assert_allclose(whole["mean_mm"], parts["mean_mm"], atol=0.005)
    check_drawn(tmp_path / "whole", tmp_path / "parts")
    fit(files, tmp_path / "parts", resume=True, step=2)  # nothing left to fit: written anew
    with np.load(tmp_path / "parts" / "sequence.npz") as again:
        np.testing.assert_array_equal(again["activations"], parts["activations"])
    check_drawn(tmp_path / "whole", tmp_path / "parts")
    with pytest.raises(InputError) as caught:
        fit(files, tmp_path / "parts", resume=True, step=1)
    assert caught.value.code == "sequence.resume"


def check_drawn(whole: Path, parts: Path) -> None:
    """Check that a sequence is drawn as one that was fitted without a break, all of its frames."""
    expected, found = (
        shown_skins(folder / "sequence.glb", MODEL.skin.vertices) for folder in (whole, parts)
    )
    assert len(expected) == len(np.load(whole / "sequence.npz")["frame"])
    # stored poses are settled, a frame that is tracked ends near its equilibrium
    within = CorrectorOptions.close_mm + SEQUENCE_BASIS.within_mm
    np.testing.assert_allclose(found, expected, atol=within)
    pictures = [Image.open(folder / "sequence.png") for folder in (whole, parts)]
    assert pictures[0].size == pictures[1].size  # a column a frame


def test_what_can_not_be_seen_keeps_the_pose(files: Path, tmp_path: Path) -> None:
    frames = np.load(files / "take.npy")
    frames[2, 2:] = np.nan
    frames[3, ::2] = np.nan
    np.save(files / "hidden.npy", frames)
    fit(files, tmp_path, "hidden.npy", end=5)
    found = np.load(tmp_path / "sequence.npz")
    assert found["status"].tolist() == ["fitted", "fitted", "unseen", "fitted", "fitted"]
    np.testing.assert_array_equal(found["activations"][1], found["activations"][2])
    assert np.isnan(found["mean_mm"][2])
    assert found["mean_mm"][3] < 0.02
    report = json.loads((tmp_path / "sequence.json").read_text())
    assert (report["fitted"], report["unseen"]) == (4, [2])


def test_what_can_not_be_fitted_keeps_the_pose_and_warns(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []
    steps = []
    whole = FrameSolver.fit

    def fails_once(solver: FrameSolver, *parts: Any) -> int:
        calls.append(parts)
        if len(calls) == 3:
            raise SolveError("solve.no_convergence", "the face does not come to rest")
        return whole(solver, *parts)

    monkeypatch.setattr(FrameSolver, "fit", fails_once)
    how = {"options": {"end": 5}, "progress": steps.append}
    run_job("fit_sequence", tmp_path, **how, **inputs_of(files))
    found = np.load(tmp_path / "sequence.npz")
    assert found["status"].tolist() == ["fitted", "fitted", "kept", "fitted", "fitted"]
    np.testing.assert_array_equal(found["activations"][1], found["activations"][2])
    assert found["mean_mm"][3] < 0.02
    nobody, warning = [step.message for step in steps if step.phase == "warning"]
    assert "no muscle is expected to pull" in str(nobody)
    assert "frame 2 keeps the pose" in warning


def test_known_activations_are_kept_to_and_disagreement_is_told(
    files: Path, tmp_path: Path
) -> None:
    """The left muscle contracts by 0.24 at most; the right one is said to in frames 2 to 4."""
    fibres = np.where(MODEL.weights.indices[:, None] > 0, [1.0, 0.0, 0.0], 0.0)
    Rig(replace(MODEL, fibres=fibres), MODEL.weights, ()).save(tmp_path / "rig.npz")
    true = 0.25 * np.sin(0.4 * np.arange(FRAMES))
    rows = [f"left,{number / 10.0},{value},0.02" for number, value in enumerate(true)]
    rows += [f"right,{number / 10.0},0.5,0.01" for number in (2, 4)]
    table = tmp_path / "emg.csv"
    table.write_text("\n".join(["muscle,time,value,sd", *rows]))
    inputs = {**inputs_of(files), "rig": tmp_path / "rig.npz", "activations": table}
    steps: list[Step] = []
    options = {"fps": 10.0}
    run_job("fit_sequence", tmp_path / "out", options=options, progress=steps.append, **inputs)
    report = json.loads((tmp_path / "out" / "sequence.json").read_text())
    known = report["known"]
    assert [known[name]["frames"] for name in ("left", "right")] == [FRAMES, 3]
    assert known["left"]["rms"] < 0.02
    assert known["right"]["beyond"] == 1.0
    assert known["right"]["worst"]["frame"] in {2, 3, 4}
    nobody, notice = report["notices"]
    assert nobody["code"] == "recruitment.none"
    assert (notice["code"], notice["muscle"]) == ("activations.disagree", "right")
    assert notice["message"] in [step.message for step in steps if step.phase == "warning"]
    table.write_text("muscle,time,value,sd\nleft,3,0.1,0.1")
    with pytest.raises(InputError, match=r"lasts 0\.8 s") as refused:
        run_job("fit_sequence", tmp_path / "out", options=options, **inputs)
    assert refused.value.code == "activations.time"


def test_another_face_is_refused_with_its_distance(files: Path, tmp_path: Path) -> None:
    frames = np.load(files / "take.npy")
    frames += np.random.default_rng(1).normal(0.0, 8.0, frames.shape[1:]).astype(frames.dtype)
    np.save(files / "another.npy", frames)
    with pytest.raises(InputError, match="mirrored, another person's") as caught:
        fit(files, tmp_path, "another.npy")
    assert caught.value.code == "performance.unlike"


def test_frames_are_fitted_to_planes_too(files: Path, tmp_path: Path) -> None:
    for distance in ("point", "plane"):
        fit(files, tmp_path / distance, end=3, distance=distance)
    points, planes = (np.load(tmp_path / d / "sequence.npz") for d in ("point", "plane"))
    assert (planes["status"] == "fitted").all()
    assert not np.allclose(planes["activations"], points["activations"], atol=1e-3)
    with pytest.raises(InputError, match="not one of 'point' or 'plane'") as caught:
        fit(files, tmp_path, distance="surface")
    assert caught.value.code == "options.distance"


def test_frames_that_are_not_there(files: Path, tmp_path: Path) -> None:
    for options in ({"start": FRAMES}, {"end": FRAMES + 1}, {"start": 3, "end": 3}):
        with pytest.raises(InputError) as caught:
            fit(files, tmp_path, **options)
        assert caught.value.code == "options.frames"


def test_a_temporal_weight_calms_noise(files: Path, tmp_path: Path) -> None:
    frames = np.load(files / "take.npy")
    frames += np.random.default_rng(3).normal(0.0, 0.3, frames.shape)
    np.save(files / "noisy.npy", frames)
    jitter = []
    for weight in (0.0, 5.0):
        fit(files, tmp_path, "noisy.npy", temporal=weight)
        activations = np.load(tmp_path / "sequence.npz")["activations"]
        jitter.append(np.abs(np.diff(activations, n=2, axis=0)).mean())
    assert jitter[1] < 0.6 * jitter[0]


def test_a_rig_fitted_within_limits_is_followed_within_them(tmp_path: Path) -> None:
    """Muscles push along their fibres, as none can, and come back; the fit is broken off once."""
    model = fibred_block()
    drive = Admissible(limits_by_plausibility(1.0))
    face = Face(model)
    rest = face.rest_pose()
    state = face.rest
    frames = []
    push = np.tile([0.35, 0.0, 0.0, -0.1, 0.0, -0.1], (2, 1))
    for number in range(FRAMES):
        pose = Pose(rest.a + np.sin(0.4 * number) * push, JAW * np.sin(0.4 * number))
        state = face.continuation(state, pose)
        frames.append(face.face_points(state.x))
    np.save(tmp_path / "take.npy", frames)
    limits = face.driven_as(drive).layout.bounds.feasible
    assert limits is not None
    beyond = {}
    for name, how in (("free", SixNumbers()), ("within", drive)):
        Rig(model, model.weights, (), drive=how).save(tmp_path / "rig.npz")
        fit(tmp_path, tmp_path / name, end=5, temporal=1e-3)
        fit(tmp_path, tmp_path / name, resume=True, temporal=1e-3)
        with np.load(tmp_path / name / "sequence.npz") as found:
            assert (found["status"] == "fitted").all()
            outside = [(limits.margins(a) <= 0.0).any(axis=1).sum() for a in found["activations"]]
        beyond[name] = sum(outside)
    assert beyond["free"] >= FRAMES
    assert beyond["within"] == 0


def test_the_head_s_motion_is_told_from_the_face_s() -> None:
    """The upper face of a real model lies still enough; S and the poses are made up."""
    model = fixture_model("neutral_coarse")
    face = Face(model)
    rest = face.rest_pose()
    state = face.rest
    change = np.random.default_rng(2).normal(0.0, 0.1, rest.a.shape)
    regulariser = Regulariser(w_a=2e-3, w_v=1e-2, w_b=1e-6, prior=rest)
    tracker = Tracker(DensePoints(face, regulariser, HeadAndFace(still=stillness(face))))
    for number in range(1, 3):
        pose = Pose(rest.a + number * change, number * np.array([0.06, 0.0, 0.0, 0.0, 0.5]))
        state = face.continuation(state, pose)
        turn = Rotation.from_rotvec([0.2 * number, -0.3, 0.1])
        shift = np.array([30.0 * number, 100.0, -20.0])
        seen = turn.apply(face.face_points(state.x)) + shift
        found = tracker.step(SeenPoints(seen, np.ones(len(seen))))
        assert found.status == "fitted"
        assert found.target is not None
        assert found.target.distances(face.face_points(found.state.x)).mean() < 0.05
        rest_points = model.skin.vertices[model.face]
        placed = found.head(rest_points)
        assert np.abs(placed - turn.apply(rest_points) - shift).max() < 0.1


def test_a_head_elsewhere_asks_for_its_motion(files: Path, tmp_path: Path) -> None:
    np.save(files / "away.npy", np.load(files / "take.npy") + 60.0)
    with pytest.raises(InputError, match="head_motion") as caught:
        fit(files, tmp_path, "away.npy")
    assert caught.value.code == "performance.misaligned"


def test_a_face_without_a_still_point_has_no_head(files: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError) as caught:
        fit(files, tmp_path, head_motion=True)
    assert caught.value.code == "sequence.no_still_points"
