"""A performance of a block of flesh, fitted by the weights of its tracks, whole and in parts."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.tracking.dense import HeadAndFace, SeenPoints, stillness
from solver.jobs import run_job
from solver.rig import Rig
from solver.rig.frames import ChunkOptions
from solver.similarity import small_motion
from solver.tracks.basis import MuscleTracks
from solver.tracks.face import TrackFace, track_potentials
from solver.tracks.fit import TrackFitOptions
from solver.tracks.plain import PlainFace
from solver.tracks.track import ShapeTracker
from tests.fixtures import small_model
from tests.solver.jobs.killed import killed_after
from tests.solver.jobs.test_fit_photo import shapes as photo_shapes
from tests.solver.jobs.test_fit_tracks import MODEL, shapes

pytestmark = pytest.mark.long

FRAMES = 5
WEIGHTS = np.column_stack([np.linspace(0.0, 0.7, FRAMES), 0.5 * np.sin(np.arange(FRAMES))])
WEIGHTS = np.clip(WEIGHTS, 0.0, 1.0)
NOD = np.array([0.05, 0.02, 0.0, 1.0, -2.0, 0.5])


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig, its tracks, and what they do."""
    folder = tmp_path_factory.mktemp("take")
    tracks = MuscleTracks.of(MODEL, shapes())
    tracks.save(folder / "tracks.npz")
    face = TrackFace(MODEL, tracks, track_potentials(MODEL))
    state = face.rest()
    frames = []
    for row in WEIGHTS:
        state = face.move(state, np.concatenate([row, np.zeros(5)]))
        frames.append(face.skin(state))
    np.save(folder / "take.npy", frames)
    Rig(MODEL, MODEL.weights, ()).save(folder / "rig.npz")
    return folder


def fit(files: Path, out: Path, take: str = "take.npy", **more: Any) -> dict[str, np.ndarray]:
    """Fit a take and return what the sequence has."""
    inputs = {name: files / f"{name}.npz" for name in ("rig", "tracks")}
    options = {"system": "T", **more.pop("options", {})}
    run_job("fit_sequence", out, performance=files / take, options=options, **inputs, **more)
    with np.load(out / "sequence.npz") as found:
        return dict(found)


def test_weights_come_back_and_a_job_that_was_killed_goes_on(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.jobs.sequences.FrameFitter.chunks", ChunkOptions(frames=2))
    whole = fit(files, tmp_path / "whole")
    assert (int(whole["format"]), whole["shapes"].tolist()) == (3, ["aside", "bulge"])
    np.testing.assert_allclose(whole["weights"], WEIGHTS, atol=0.03)
    assert whole["mean_mm"].max() < 0.05
    assert whole["inverted"].max() == 0
    report = json.loads((tmp_path / "whole" / "sequence.json").read_text())
    assert (report["system"], report["fitted"]) == ("T", FRAMES)
    rows = list(csv.DictReader((tmp_path / "whole" / "activations.csv").open()))
    assert float(rows[4]["shape.aside"]) == pytest.approx(whole["weights"][4, 0], abs=1e-6)

    with killed_after(3, FRAMES) as progress:
        fit(files, tmp_path / "parts", progress=progress)
    parts = fit(files, tmp_path / "parts", resume=True)
    np.testing.assert_array_equal(parts["weights"][:3], whole["weights"][:3])
    np.testing.assert_allclose(parts["weights"], whole["weights"], atol=0.01)
    assert (tmp_path / "parts" / "sequence.glb").is_file()


def test_a_scene_plays_the_weights(files: Path, tmp_path: Path) -> None:
    fit(files, tmp_path / "take", options={"fps": 10.0})
    inputs = {name: files / f"{name}.npz" for name in ("rig", "tracks")}
    scene = {"drive": "tracks", "fps": 10, "performance": {"asset": "take"}}
    given = {"captures": {"take": tmp_path / "take" / "sequence.npz"}, **inputs}
    run_job("simulate", tmp_path / "played", options={"scene": scene}, **given)
    with np.load(tmp_path / "played" / "animation.npz") as found:
        wanted = np.load(files / "take.npy")[:, MODEL.face]
        assert np.linalg.norm(found["skin"] - wanted, axis=2).mean() < 0.05
    more = {"performance": {"asset": "take", "gain": 0.0}}
    run_job("simulate", tmp_path / "still", options={"scene": scene | more}, **given)
    with np.load(tmp_path / "still" / "animation.npz") as found:
        assert np.abs(found["skin"] - MODEL.skin.vertices[MODEL.face]).max() < 0.01
    for wrong in (
        {"drive": "muscles"},
        {"performance": {"asset": "take", "mask": ["left"]}},
        {"performance": [{"asset": "take"}, {"asset": "take"}]},
    ):
        with pytest.raises(InputError) as refused:
            run_job("simulate", tmp_path / "wrong", options={"scene": scene | wrong}, **given)
        assert refused.value.code == "scene.shapes"


def test_changes_cost_and_what_is_hidden_keeps_the_pose(files: Path, tmp_path: Path) -> None:
    frames = np.load(files / "take.npy")
    frames[2] = np.nan
    np.save(files / "hidden.npy", frames)
    found = fit(files, tmp_path / "hidden", "hidden.npy")
    assert found["status"].tolist() == ["fitted", "fitted", "unseen", "fitted", "fitted"]
    np.testing.assert_array_equal(found["weights"][1], found["weights"][2])
    slow = fit(files, tmp_path / "slow", options={"temporal": 3.0})
    changes = [np.abs(np.diff(each["weights"], axis=0)).sum() for each in (slow, found)]
    assert changes[0] < 0.9 * changes[1]


def test_the_heads_motion_is_told_from_the_face() -> None:
    model = small_model()
    face = PlainFace(model, MuscleTracks.of(model, photo_shapes()))
    points = HeadAndFace(still=stillness(face.face))
    tracker = ShapeTracker(face, points, TrackFitOptions())
    wanted = face.tracks.controls({"mouthSmileLeft": 0.8, "browInnerUp": 0.5})
    for share in (0.0, 0.5, 1.0):
        nod = small_motion(share * NOD)
        state = face.move(tracker.state, share * wanted)
        seen = nod(face.face.face_points(state.x))
        found = tracker.step(SeenPoints(seen, np.ones(len(seen))))
    assert found.target is not None
    assert found.target.distances(face.face.face_points(found.state.x)).mean() < 0.1
    np.testing.assert_allclose(found.head.twist[:3], NOD[:3], atol=0.003)
    np.testing.assert_allclose(found.state.q[:-5], wanted[:-5], atol=0.1)


def test_known_activations_say_nothing_of_shapes(files: Path, tmp_path: Path) -> None:
    table = tmp_path / "emg.csv"
    table.write_text("muscle,time,value,sd\nleft,0,0.1,0.1")
    with pytest.raises(InputError, match="says nothing of shapes") as refused:
        fit(files, tmp_path / "out", activations=table)
    assert refused.value.code == "options.system"
