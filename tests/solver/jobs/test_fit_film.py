"""The job that fits a film: frames in their order, from the one before, resumed and bridged."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from solver.errors import InputError
from solver.jobs import run_job
from solver.rig.frames import ChunkOptions
from solver.rig.frames.animation import write_video
from solver.tracks.basis import MuscleTracks
from tests.fixtures import face_landmarker, small_rig
from tests.solver.jobs.killed import killed_after
from tests.solver.jobs.test_fit_photo import MODEL, NEUTRAL, WEIGHTS, photograph, shapes, smile

pytestmark = pytest.mark.long

FRAMES = 6
SHARES = np.linspace(0.0, 1.0, FRAMES)
NAMES = [f"take {5 * number}" for number in range(FRAMES)]  # 10 comes after 5


def yaw(number: int) -> float:
    return 2.0 * number


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig, its tracks, and a film in which a smile grows while the head turns."""
    folder = tmp_path_factory.mktemp("film")
    small_rig().save(folder / "rig.npz")
    MuscleTracks.of(MODEL, shapes()).save(folder / "tracks.npz")
    (folder / "pictures").mkdir()
    for number, name in enumerate(NAMES):
        skin = NEUTRAL + SHARES[number] * (smile() - NEUTRAL)
        photograph(folder / "pictures", name, skin, yaw(number))
    return folder


def fit(files: Path, out: Path, *, resume: bool = False, **more: Any) -> dict[str, np.ndarray]:
    """Fit a film and return what the sequence has."""
    options = {"sequence": True, "model": "shapes", "fps": 25.0, **more.pop("options", {})}
    inputs = {name: files / f"{name}.npz" for name in ("rig", "tracks")}
    run_job("fit_photo", out, options=options, resume=resume, **inputs, **more)
    with np.load(out / "sequence.npz") as found:
        return dict(found)


def pictures(files: Path, *names: str) -> dict[str, Any]:
    """Return photographs, in no order, with their landmarks."""
    folder = files / "pictures"
    chosen = sorted(names or NAMES)
    return {
        "captures": {name: folder / f"{name}.jpg" for name in chosen},
        "facts": {name: folder / f"{name}.json" for name in chosen},
    }


def test_a_smile_grows_while_the_head_turns(files: Path, tmp_path: Path) -> None:
    found = fit(files, tmp_path, **pictures(files))
    assert (found["status"] == "fitted").all()
    assert found["shapes"].tolist() == list(shapes())
    np.testing.assert_allclose(found["time"], np.arange(FRAMES) / 25.0)
    names = found["shapes"].tolist()
    smiles = found["weights"][:, [names.index(name) for name in WEIGHTS]].mean(axis=1)
    assert np.corrcoef(smiles, SHARES)[0, 1] > 0.98
    # one camera, which stands still, and a head that turns before it
    turned = np.degrees(found["head"][:, 1] - found["head"][0, 1])
    np.testing.assert_allclose(turned, [yaw(number) for number in range(FRAMES)], atol=2.5)
    np.testing.assert_allclose(found["head"][0, 3:], 0.0, atol=1e-6)
    assert found["mean_mm"].max() < 1.5
    report = json.loads((tmp_path / "sequence.json").read_text())
    assert (report["fitted"], report["system"], report["missing"]) == (FRAMES, "B", {})
    assert report["film"]["camera"]["focal"] == found["camera_focal"].tolist()
    assert Image.open(tmp_path / "photo.png").height > 1000
    assert (tmp_path / "sequence.glb").is_file()


def test_a_film_in_flesh_goes_on_where_it_was_killed(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("solver.jobs.sequences.FrameFitter.chunks", ChunkOptions(frames=1))
    given = {"film": files / "pictures", "options": {"model": "tracks", "end": 4}}
    whole = fit(files, tmp_path / "whole", **given)
    assert whole["inverted"].max() == 0

    with killed_after(3, 4) as progress:
        fit(files, tmp_path / "parts", progress=progress, **given)
    parts = fit(files, tmp_path / "parts", resume=True, **given)
    np.testing.assert_array_equal(parts["weights"][:3], whole["weights"][:3])
    np.testing.assert_allclose(parts["weights"], whole["weights"], atol=0.02)
    np.testing.assert_allclose(parts["head"], whole["head"], atol=0.05)


def test_light_is_found_once(files: Path, tmp_path: Path) -> None:
    options = {"shading": True, "neutral": NAMES[0]}
    found = fit(files, tmp_path, options=options, **pictures(files, *NAMES[:3]))
    assert (found["status"] == "fitted").all()


def test_dark_frames_are_told_once(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "dark"
    folder.mkdir()
    for number, name in enumerate(NAMES[:3]):
        shutil.copy(files / "pictures" / f"{name}.json", folder)
        with Image.open(files / "pictures" / f"{name}.jpg") as picture:
            shown = picture.point(lambda value: value // 20) if number else picture
            shown.save(folder / f"{name}.jpg", quality=95)
    fit(files, tmp_path, film=folder)
    (told,) = json.loads((tmp_path / "sequence.json").read_text())["notices"]
    assert (told["code"], told["frames"]) == ("photo.exposure", [1, 2])


def test_frames_without_a_face_are_bridged(files: Path, tmp_path: Path) -> None:
    """The frames of a film's file, in which the face is gone for a while."""
    pytest.importorskip("av")
    landmarker = face_landmarker()
    shown = [Image.open(files / "pictures" / f"{name}.jpg") for name in NAMES]
    plates = [np.asarray(each, np.float32) / 255.0 for each in shown]
    plates[3:5] = [np.full_like(plates[0], 0.3)] * 2
    order = [0, 0, 1, 2, 3, 4, 5, 5, 5]
    size = (plates[0].shape[1], plates[0].shape[0])
    write_video(tmp_path / "film.mp4", [plates[k] for k in order], size, 25.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MYOFACE_FACE_LANDMARKER", str(landmarker))
        found = fit(files, tmp_path / "out", film=tmp_path / "film.mp4")
    assert found["status"].tolist() == 4 * ["fitted"] + 2 * ["unseen"] + 3 * ["fitted"]
    np.testing.assert_array_equal(found["weights"][4], found["weights"][3])
    np.testing.assert_array_equal(found["head"][5], found["head"][3])
    report = json.loads((tmp_path / "out" / "sequence.json").read_text())
    assert report["missing"] == {"4": "photo.no_face", "5": "photo.no_face"}


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        ({}, "job.missing", "needs a film"),
        ({"options": {"sequence": False}}, "options.sequence", "by sequence: ask for it"),
        ({"options": {"neutral": "back"}}, "photo.neutral", "no frame 'back'"),
        ({"options": {"start": 9}}, "options.frames", "0 to 5"),
    ],
)
def test_what_a_film_is_refused_for(
    files: Path, tmp_path: Path, more: dict[str, Any], code: str, words: str
) -> None:
    given = {"film": files / "pictures"} if more else {}
    with pytest.raises(InputError, match=words) as refused:
        fit(files, tmp_path, **given, **more)
    assert refused.value.code == code


def test_pictures_of_two_sizes_are_no_film(files: Path, tmp_path: Path) -> None:
    given = pictures(files, *NAMES[:2])
    larger = tmp_path / "larger.jpg"
    Image.open(given["captures"][NAMES[1]]).resize((540, 720)).save(larger)
    given["captures"][NAMES[1]] = larger
    with pytest.raises(InputError, match="of one size") as refused:
        fit(files, tmp_path / "out", **given)
    assert refused.value.code == "film.sizes"
