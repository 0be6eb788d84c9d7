"""Scenes and recordings that muscle tracks play: shapes are reached, and what else is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from solver.errors import InputError
from solver.jobs import run_job
from solver.progress import Step
from solver.rig import Rig
from solver.scans import recordings
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.tracks.basis import MuscleTracks, TrackOptions
from tests.solver.tracks.block import OPEN, block_shapes, tracked_block

MODEL = tracked_block()
SHAPES = block_shapes(MODEL)
NAMED = {"mouthPucker": SHAPES["bulge"], "jawOpen": SHAPES["open"], "ours": SHAPES["aside"]}
KEYS = [{"time": 0}, {"time": 0.2, "shapes": {"mouthPucker": 1.0, "jawOpen": 0.5, "ours": 1.0}}]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A rig without a fitted expression, and the tracks of its model."""
    folder = tmp_path_factory.mktemp("tracks")
    Rig(MODEL, MODEL.weights, ()).save(folder / "rig.npz")
    MuscleTracks.of(MODEL, NAMED, TrackOptions(length_mm=0.5)).save(folder / "tracks.npz")
    return {"rig": folder / "rig.npz", "tracks": folder / "tracks.npz"}


def play(files: dict[str, Path], out: Path, scene: dict[str, Any], **how: Any) -> dict[str, Any]:
    options = {"scene": {"drive": "tracks", "fps": 10, **scene}}
    run_job("simulate", out, options=options, **files, **how)
    report: dict[str, Any] = json.loads((out / "animation.json").read_text())
    with np.load(out / "animation.npz") as data:
        return report | {name: data[name] for name in data.files}


def test_keys_of_shapes_are_reached(files: dict[str, Path], tmp_path: Path) -> None:
    found = play(files, tmp_path, {"keys": KEYS})
    assert (found["frames"], found["shapes"]) == (3, 3)
    assert found["inverted"].tolist() == [0, 0, 0]
    goal = SHAPES["bulge"] + 0.5 * SHAPES["open"] + SHAPES["aside"]
    moved = found["skin"][-1] - MODEL.skin.vertices[MODEL.face]
    off = np.linalg.norm(moved - goal[MODEL.face], axis=1).mean()
    assert off < 0.2 * np.linalg.norm(goal[MODEL.face], axis=1).mean()
    assert np.allclose(found["jaw"][-1], 0.5 * OPEN, atol=1e-6)
    # muscles: what they are asked for, and how long they are
    assert found["activations"].shape == (3, 2, 6)
    assert np.abs(found["activations"][-1] - found["activations"][0]).max() > 0.005
    assert found["lengths"].shape == (3, 2)
    assert np.abs(found["lengths"][-1] / found["lengths"][0] - 1.0).max() > 0.005


@pytest.mark.long
def test_scenes_keep_their_forces_edits_and_inertia(files: dict[str, Path], tmp_path: Path) -> None:
    pull = {"kind": "point", "at": [25, 20, 15], "mn": [0, 0, 2000], "radius_mm": 15}
    keys = {"keys": [{"time": 0}, {"time": 0.1, "shapes": {"mouthPucker": 1.0}}]}
    plain = play(files, tmp_path / "plain", keys)["skin"]
    pulled = play(files, tmp_path / "pulled", {**keys, "forces": [pull]})["skin"]
    assert np.abs(pulled[-1] - plain[-1]).max() > 0.05
    weak = play(files, tmp_path / "weak", {**keys, "edits": [{"kind": "paralysis"}]})["skin"]
    assert np.abs(weak[-1] - weak[0]).max() < 1e-3 < 0.5 < np.abs(plain[-1] - plain[0]).max()
    heavy = {"mode": "dynamic", "edits": [{"kind": "density", "factor": 100}], "fps": 240}
    sudden = [{"time": 0}, {"time": 1 / 240, "shapes": {"mouthPucker": 1.0}}]
    late = play(files, tmp_path / "late", {**heavy, "keys": sudden})["skin"]
    assert np.abs(late[-1] - plain[-1]).max() > 0.05


@pytest.mark.long
def test_a_stopped_scene_goes_on(files: dict[str, Path], tmp_path: Path) -> None:
    whole = play(files, tmp_path, {"keys": KEYS})
    again = play(files, tmp_path, {"keys": KEYS}, resume=True)
    assert np.allclose(again["skin"], whole["skin"], atol=1e-4)


def test_a_recording_needs_no_solved_shapes(files: dict[str, Path], tmp_path: Path) -> None:
    take = tmp_path / "take.csv"
    weights = {"jawOpen": 0.6, "mouthPucker": 0.8}
    with take.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["Timecode", "BlendShapeCount", *ARKIT_NAMES])
        for frame in range(3):
            row = [weights.get(name, 0.0) * frame / 2.0 for name in ARKIT_NAMES]
            table.writerow([f"00:00:00:{frame:02d}.000", len(row), *row])
    scene = {"drive": "tracks", "recording": {"asset": "take"}}
    how: dict[str, Any] = {"options": {"scene": scene}, "captures": {"take": take}}
    left = run_job("animate", tmp_path / "out", **how, **files)
    assert not {"blendshapes.npz", "expression_basis.npz"} & {file.name for file in left}
    with np.load(tmp_path / "out" / "animation.npz") as data:
        assert np.allclose(data["jaw"][-1], 0.6 * OPEN, atol=1e-6)
        bulged = np.abs(data["skin"][-1] - data["skin"][0]).max()
    assert bulged > 0.5


def test_a_recording_is_known_by_what_it_holds(files: dict[str, Path], tmp_path: Path) -> None:
    """OpenFace's is played by its own options, of which Live Link's refuses some."""
    take = tmp_path / "take.txt"
    other = tmp_path / "other.csv"
    rows = ["timestamp, success, pose_Rx, pose_Ry, pose_Rz, AU17_r, AU26_r"]
    rows += [f"{frame / 10},{int(frame != 1)},0,{0.1 * frame},0,0,{frame}" for frame in range(4)]
    take.write_text("\n".join(rows))
    options = {"neutral": 0, "gain": 1.5, "end": 4}
    scene = {"drive": "tracks", "recording": {"asset": "take", **options}}
    how: dict[str, Any] = {"options": {"scene": scene}}
    steps: list[Step] = []
    out = tmp_path / "out"
    run_job("animate", out, captures={"take": take}, progress=steps.append, **how, **files)
    with np.load(out / "animation.npz") as data:
        # 0.6 of the shape at full intensity; what was not seen is between its neighbours
        opened = 1.5 * 0.6 / 5.0 * np.arange(4)
        assert np.allclose(data["jaw"], opened[:, None] * OPEN, atol=1e-6)
        assert np.allclose(data["head"][-1, :3], [0.0, -0.3, 0.0], atol=1e-6)
    report = json.loads((out / "animation.json").read_text())
    told = {"format": "openface", "seen": 3, "gaps": 1, "longest_gap_s": 0.2, "controls": "tracks"}
    assert report["transfer"].items() >= told.items()
    assert "jawOpen" not in report["transfer"]["unseen_shapes"]
    assert [notice["code"] for notice in report["notices"]] == ["openface.gaps"]
    assert [step.message for step in steps if step.phase == "warning"] == [
        report["notices"][0]["message"]
    ]
    row = ["00:00:00:01", "0", *("0" for _ in ARKIT_NAMES)]
    other.write_text("\n".join([",".join(["Timecode", "Count", *ARKIT_NAMES]), ",".join(row)]))
    scene["recording"] = {"asset": "take", "au_scale": 1.0}
    with pytest.raises(InputError, match="au_scale") as error:
        run_job("animate", tmp_path / "no", captures={"take": other}, **how, **files)
    assert error.value.code == "live_link.options"


@pytest.mark.long
def test_what_is_measured_of_a_video_is_left_and_plays_as_it(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = np.zeros((6, len(ARKIT_NAMES)))
    weights[:, ARKIT_NAMES.index("jawOpen")] = [0.1, 0.1, 0.3, 0.0, 0.6, 0.6]
    head = 0.1 * weights[:, :3]
    eyes = np.zeros((6, 2, 3))
    seen = np.arange(6) != 3
    measured = FaceTake(np.arange(6) / 25.0, weights, head, eyes, seen, "video")
    monkeypatch.setattr(recordings, "read_video", lambda *_, **__: measured)
    film = tmp_path / "film.mov"
    film.write_bytes(b"\0\0\0\x14ftypqt  ")
    outs = []
    for name, asset in (("film", film), ("again", tmp_path / "film" / "signals.csv")):
        outs.append(tmp_path / name)
        scene = {"drive": "tracks", "recording": {"asset": "take", "start": 1}}
        how: dict[str, Any] = {"options": {"scene": scene}}
        left = run_job("animate", outs[-1], captures={"take": asset}, **how, **files)
        assert ("signals.csv" in {path.name for path in left}) == (name == "film")
    kept = outs[0] / "signals.csv"
    run_job("animate", outs[0], captures={"take": kept}, **how, **files)
    assert kept.is_file()  # what is played is not taken away, in its own folder either
    played = [np.load(out / "animation.npz") for out in outs]
    assert played[0]["seen"].tolist() == [True, True, False, True, True]
    assert played[0]["jaw"].max() > 0.0
    for name in ("weights", "jaw", "head", "seen"):
        np.testing.assert_allclose(played[1][name], played[0][name], atol=1e-7)
    told = json.loads((outs[0] / "animation.json").read_text())
    assert told["transfer"]["format"] == "video"
    assert [notice["code"] for notice in told["notices"]] == ["video.gaps"]


@pytest.mark.parametrize(
    ("scene", "code"),
    [
        ({"keys": [{"time": 0, "shapes": {"mouthPuker": 1.0}}]}, "tracks.name"),
        ({"keys": [{"time": 0, "muscles": {"left": 0.8}}]}, "scene.shapes"),
        ({"keys": [{"time": 0, "expressions": {"smile": 1.0}}]}, "scene.shapes"),
        ({"performance": {"asset": "take"}}, "scene.asset"),
        ({"keys": KEYS, "drive": "muscles"}, "scene.shapes"),
        ({"keys": [{"time": 0, "shapes": {"jawOpen": 1.0}, "jaw": {"open_deg": 90}}]}, "scene.jaw"),
    ],
)
def test_what_tracks_do_not_play_is_refused(
    files: dict[str, Path], tmp_path: Path, scene: dict[str, Any], code: str
) -> None:
    with pytest.raises(InputError) as error:
        play(files, tmp_path, scene)
    assert error.value.code == code


def test_a_scene_by_tracks_needs_them(files: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tracks") as error:
        play({"rig": files["rig"]}, tmp_path, {"keys": KEYS})
    assert error.value.code == "job.missing"
