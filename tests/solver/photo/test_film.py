"""Films: their pictures in order, and what a frame supposes by the one before."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image

from solver.errors import InputError
from solver.photo.camera import PinholeCamera
from solver.photo.film import FilmOptions, FilmTracker, FrameProblem, RandomWalk, StepNoise
from solver.photo.fit import PhotoFitOptions, PhotoPoint, PhotoProblem, PhotoView
from solver.photo.footage import FilmFile, Pictures, open_film
from solver.photo.mesh_points import landmark_points
from solver.photo.photo import Photo
from solver.photo.terms import LandmarkTerm
from solver.rig.frames.animation import write_video
from solver.similarity import IDENTITY
from solver.storage import natural_order
from solver.templates.builtin.build import builtin_template
from solver.tracks.basis import MuscleTracks
from solver.tracks.plain import PlainFace
from tests.fixtures import small_model
from tests.solver.jobs.test_fit_photo import camera, shapes

MODEL = small_model()
POINTS = landmark_points(builtin_template())
SIZE = (96, 64)


def face() -> PlainFace:
    return PlainFace(MODEL, MuscleTracks.of(MODEL, shapes()))


def test_names_are_in_natural_order() -> None:
    assert natural_order(["b1", "a10", "A2", "a1"]) == ["a1", "A2", "a10", "b1"]


def test_a_frames_gradient_is_that_of_its_value() -> None:
    driven = face()
    seen_by = camera(5.0)
    state = driven.move(driven.rest(), driven.tracks.controls({"browInnerUp": 0.3}))
    pixels = seen_by.project(POINTS.at(driven.skin(state)))[:, :2]
    view = PhotoView((LandmarkTerm(POINTS, pixels, np.full(len(pixels), 2.0)),), seen_by)
    before = PhotoPoint(driven.rest(), driven.skin(driven.rest()), IDENTITY, (seen_by,))
    walk = RandomWalk(before, StepNoise(), 1.0)
    problem = FrameProblem(PhotoProblem(driven, (view,), PhotoFitOptions(), moves_face=True), walk)
    # a little way off, where the walk pulls back in weights and head
    start = np.concatenate([np.full(len(state.q) - 5, 0.2), np.zeros(5)])
    moved = seen_by.moved(np.array([1e-4, -2e-4, 1e-4, 2.0, -1.0, 5.0, 0.0]))
    there = driven.move(driven.rest(), start)
    point = PhotoPoint(there, driven.skin(there), IDENTITY, (moved,))
    gradient = problem.linearise(point).gradient
    eps = 1e-5
    found = []
    for number in range(len(gradient)):
        values = []
        for sign in (1.0, -1.0):
            change = np.zeros(len(gradient))
            change[number] = sign * eps
            state = driven.move(there, point.state.q + change[: len(start)])
            own = moved.moved(np.append(change[len(start) :], 0.0))
            values.append(problem.value(PhotoPoint(state, driven.skin(state), IDENTITY, (own,))))
        found.append((values[0] - values[1]) / (2 * eps))
    assert np.linalg.norm(gradient) > 10.0
    np.testing.assert_allclose(gradient, found, rtol=2e-4, atol=2e-4 * np.abs(gradient).max())


def plate(driven: PlainFace, weights: dict[str, float], seen_by: PinholeCamera) -> Photo:
    """Return a picture with exact landmarks, and nothing to see."""
    skin = driven.skin(driven.move(driven.rest(), driven.tracks.controls(weights)))
    places = seen_by.project(POINTS.at(skin))[:, :2]
    return Photo(
        "frame",
        np.zeros((360, 270, 3), np.float32),
        landmarks=dict(zip(POINTS.names, places, strict=True)),
    )


def test_a_gap_widens_what_is_supposed_and_a_cut_looks_for_the_head() -> None:
    driven = face()
    tracker = FilmTracker(driven, POINTS, np.full(2, 700.0), FilmOptions())
    tracker.step(plate(driven, {}, camera(0.0)))
    before = tracker.point
    tracker.step(plate(driven, {"mouthFunnel": 0.9}, camera(0.0)))
    near = tracker.state.q
    tracker.point = before
    for _ in range(20):
        tracker.pause()
    tracker.step(plate(driven, {"mouthFunnel": 0.9}, camera(0.0)))
    far = tracker.state.q
    assert 0.0 < near.max() < far.max()
    turned = replace(
        camera(-35.0), translation=camera(-35.0).translation + np.array([60.0, 0.0, 200.0])
    )
    tracker.step(plate(driven, {"mouthFunnel": 0.9}, turned))
    (found,) = tracker.point.cameras
    np.testing.assert_allclose(found.rotation, turned.rotation, atol=0.05)
    np.testing.assert_allclose(found.translation, turned.translation, atol=25.0)


def test_a_films_file_is_read_in_any_order(tmp_path: Path) -> None:
    pytest.importorskip("av")
    plates = [np.full((SIZE[1], SIZE[0], 3), 0.1 * number) for number in range(6)]
    write_video(tmp_path / "film.mp4", plates, SIZE, 25.0)
    film = FilmFile(tmp_path / "film.mp4")
    assert (len(film), film.number("5"), film.number("6")) == (6, 5, None)
    for number in (0, 3, 2, 5):
        photo = film.photo(number)
        assert photo.size == SIZE
        assert photo.pixels.mean() == pytest.approx(0.1 * number, abs=0.03)


def test_what_is_no_film_is_told(tmp_path: Path) -> None:
    pytest.importorskip("av")
    (tmp_path / "film.mp4").write_bytes(b"none" * 100)
    (tmp_path / "folder").mkdir()
    for name in ("film.mp4", "folder"):
        with pytest.raises(InputError) as refused, open_film(tmp_path / name):
            pass
        assert refused.value.code == "film.unreadable"
    small = [np.zeros((32, 48, 3))] * 2
    write_video(tmp_path / "small.mp4", small, (48, 32), 25.0)
    small_film = open_film(tmp_path / "small.mp4")
    with pytest.raises(InputError, match="48 x 32") as refused, small_film:
        pass
    assert refused.value.code == "film.size"


def test_a_folder_of_pictures_is_a_film(tmp_path: Path) -> None:
    for number in (10, 9):
        Image.new("RGB", SIZE, (10 * number, 0, 0)).save(tmp_path / f"{number}.png")
    (tmp_path / "notes.txt").write_text("")
    with open_film(tmp_path) as film:
        assert isinstance(film, Pictures)
        assert [film.photo(number).name for number in range(len(film))] == ["9", "10"]


def pack(path: Path, members: Mapping[str, bytes]) -> Path:
    with ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_a_zip_of_pictures_is_a_film(tmp_path: Path) -> None:
    Image.new("RGB", SIZE, (90, 0, 0)).save(tmp_path / "a.png")
    picture = (tmp_path / "a.png").read_bytes()
    marks = {"1": [48.0, 40.0], "33": [30.0, 20.0], "263": [66.0, 20.0], "152": [48.0, 60.0]}
    facts = json.dumps({"landmarks": marks}).encode()
    members = {f"day/{number}.png": picture for number in (10, 9)}
    members |= {"day/9.json": facts, "read me.txt": b"", "meta/info.json": b"{}"}
    members |= {"__MACOSX/day/._9.png": b"none"}
    with open_film(pack(tmp_path / "day.ZIP", members)) as film:
        assert isinstance(film, Pictures)
        assert film.name == "day.ZIP"
        assert [film.photo(number).name for number in range(len(film))] == ["9", "10"]
        assert [len(film.photo(number).landmarks) for number in range(2)] == [4, 0]
        folder = film.paths["9"].parent
    assert not folder.exists()
    cases = {
        "none": ({"notes.txt": b""}, "none.zip has no pictures"),
        "two": ({"a/1.png": picture, "b/1.png": picture}, "in one folder"),
        "alike": ({"1.png": picture, "1.jpg": picture}, "two pictures called 1"),
        "cut": (members, "cannot be unpacked"),
    }
    for name, (held, words) in cases.items():
        path = pack(tmp_path / f"{name}.zip", held)
        if name == "cut":
            path.write_bytes(path.read_bytes()[:-30])
        with pytest.raises(InputError, match=words) as refused, open_film(path):
            pass
        assert refused.value.code == "film.unreadable"
