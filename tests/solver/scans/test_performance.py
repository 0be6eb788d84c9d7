"""Performances: what is read, frame by frame, and how a broken one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from solver.errors import InputError
from solver.meshio.obj import write_obj
from solver.meshio.registered import write_registered
from solver.scans.performance import open_performance, write_performance
from solver.surface import Surface

BALL = trimesh.creation.icosphere(subdivisions=2, radius=90.0)
NEUTRAL = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
COUNT = len(NEUTRAL.vertices)
FACE = np.flatnonzero(NEUTRAL.vertices[:, 2] > 0)
FRAMES = NEUTRAL.vertices * np.array([1.0, 1.1, 0.9])[:, None, None]


@pytest.mark.parametrize("vertices", [np.arange(COUNT), FACE], ids=["whole skin", "face alone"])
def test_an_array_gives_the_face_s_points(vertices: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "take.npy"
    write_performance(path, iter(FRAMES[:, vertices]), len(FRAMES), len(vertices))
    take = open_performance(path, NEUTRAL, FACE)
    assert (take.name, len(take)) == ("take.npy", 3)
    for number in (2, 0):
        frame = take.frame(number)
        np.testing.assert_allclose(frame.vertices, FRAMES[number, FACE], rtol=1e-6)
        assert frame.confidence.tolist() == [1.0] * len(FACE)


def test_what_is_not_a_number_was_not_seen(tmp_path: Path) -> None:
    frames = FRAMES.copy()
    frames[1, FACE[7], 2] = np.nan
    np.save(tmp_path / "take.npy", frames)
    frame = open_performance(tmp_path / "take.npy", NEUTRAL, FACE).frame(1)
    assert np.flatnonzero(frame.confidence == 0).tolist() == [7]
    assert np.isnan(frame.vertices[7]).all()


def test_a_folder_of_scans_is_read_by_name(tmp_path: Path) -> None:
    confidence = np.ones(COUNT)
    confidence[FACE[3]] = 0.0
    write_registered(tmp_path / "take.0002.ply", NEUTRAL.with_vertices(FRAMES[1]), confidence)
    write_obj(tmp_path / "take.0001.obj", NEUTRAL)
    (tmp_path / "notes.txt").write_text("not a scan")
    take = open_performance(tmp_path, NEUTRAL, FACE)
    assert len(take) == 2
    np.testing.assert_allclose(take.frame(0).vertices, NEUTRAL.vertices[FACE], atol=1e-4)
    second = take.frame(1)
    assert np.isnan(second.vertices[3]).all()
    assert second.confidence[3] == 0.0
    np.testing.assert_allclose(second.vertices[4], FRAMES[1, FACE[4]], rtol=1e-5)


def test_frames_of_a_folder_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (1, 2, 10):
        moved = NEUTRAL.with_vertices(NEUTRAL.vertices + np.array([0.0, 0.0, number]))
        write_obj(tmp_path / f"f.{number}.obj", moved)
    (tmp_path / "._f.1.obj").write_bytes(b"of a Mac")
    take = open_performance(tmp_path, NEUTRAL, FACE)
    assert [path.name for path in take.paths] == ["f.1.obj", "f.2.obj", "f.10.obj"]


def test_a_broken_scan_in_a_folder_names_its_frame(tmp_path: Path) -> None:
    write_obj(tmp_path / "a.obj", NEUTRAL)
    (tmp_path / "b.obj").write_text("v 0 0 nan\n")
    take = open_performance(tmp_path, NEUTRAL, FACE)
    with pytest.raises(InputError) as caught:
        take.frame(1)
    assert caught.value.context["file"] == "b.obj"
    assert caught.value.context["frame"] == 1


@pytest.mark.parametrize(
    ("array", "code"),
    [
        (FRAMES[:, 1:], "shape"),
        (FRAMES[0], "shape"),
        (FRAMES.astype(int), "shape"),
        (FRAMES[:0], "empty"),
        (np.asfortranarray(FRAMES), "order"),
        (np.array([{}, None]), "unreadable"),
    ],
)
def test_another_array_is_refused(array: np.ndarray, code: str, tmp_path: Path) -> None:
    np.save(tmp_path / "take.npy", array)
    with pytest.raises(InputError) as caught:
        open_performance(tmp_path / "take.npy", NEUTRAL, FACE)
    assert caught.value.code == f"performance.{code}"


@pytest.mark.parametrize("content", [b"", b"not an array", None])
def test_another_file_is_refused(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "take.npy"
    np.save(path, FRAMES)
    path.write_bytes(path.read_bytes()[:-100] if content is None else content)
    with pytest.raises(InputError) as caught:
        open_performance(path, NEUTRAL, FACE)
    assert caught.value.code == "performance.unreadable"
    assert "take.npy" in caught.value.message


@pytest.mark.parametrize(("factor", "code"), [(np.inf, "bounds"), (1e4, "bounds"), (0.1, "unit")])
def test_a_frame_that_is_no_face_is_named(factor: float, code: str, tmp_path: Path) -> None:
    frames = FRAMES.copy()
    frames[2] = factor * (frames[2] + 1e-6)
    np.save(tmp_path / "take.npy", frames)
    take = open_performance(tmp_path / "take.npy", NEUTRAL, FACE)
    take.frame(1)
    with pytest.raises(InputError) as caught:
        take.frame(2)
    assert caught.value.code == f"performance.{code}"
    assert caught.value.context["frame"] == 2


def test_a_point_far_away_is_named_as_in_the_file(tmp_path: Path) -> None:
    frames = FRAMES.copy()
    frames[1, FACE[7]] = 1e5
    np.save(tmp_path / "take.npy", frames)
    with pytest.raises(InputError, match="frame 1") as caught:
        open_performance(tmp_path / "take.npy", NEUTRAL, FACE).frame(1)
    assert caught.value.context["vertex"] == FACE[7]
