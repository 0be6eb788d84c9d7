"""The sheet of a transfer: which frames it shows, and faces that are painted for it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from solver.registration.detector import DetectedFace
from solver.rig import transfer_sheet
from solver.rig.painted_faces import BROWS, PAINT, PaintedFaces
from solver.rig.transfer_sheet import PlayedRig, draw_transfer, face_with, most_different
from solver.scans.live_link import FaceTake, write_signals
from solver.scans.video import weights_of
from solver.templates.builtin.build import builtin_template
from tests.fixtures import small_model
from tests.solver.block import head_block


def test_the_frames_that_differ_most_are_shown_in_order() -> None:
    weights = np.zeros((50, 3))
    weights[10, 0] = weights[30, 1] = weights[20, 2] = 1.0
    weights[20:25] += 0.01
    assert most_different(weights, np.arange(50), 4).tolist() == [0, 10, 20, 30]
    assert most_different(weights, np.array([5, 10]), 4).tolist() == [5, 10]


def test_the_filmed_face_is_the_one_that_was_measured() -> None:
    large, small = (
        DetectedFace(size * np.eye(478, 2), np.eye(3), {"jawOpen": opened})
        for size, opened in ((200.0, 0.6), (100.0, 0.1))
    )
    for played in (large, small):
        assert face_with([large, small], weights_of(played)) is played


@pytest.mark.parametrize("seen", [[True, False, True], [False] * 3])
def test_frames_without_a_face_are_shown_where_there_are_no_others(
    seen: list[bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = head_block((7, 5, 1))
    weights = np.zeros((3, 52))
    still = np.zeros((3, 3))
    times = np.arange(3) / 25.0
    eyes = np.zeros((3, 2, 3))
    take = FaceTake(times, weights, still, eyes, np.array([True, True, False]), "video")
    write_signals(tmp_path / "signals.csv", take)
    np.savez(tmp_path / "animation.npz", weights=weights, seen=seen)
    frames = [
        SimpleNamespace(
            time=time,
            moved=np.zeros_like(model.rest),
            jaw=np.zeros(5),
            eyes=np.zeros((2, 3)),
            into_world=lambda skin: skin,
        )
        for time in times.tolist()
    ]
    shown = []

    def filmed(_: Path, measured: dict[int, Any], options: Any) -> dict[int, Any]:
        shown.extend(measured)
        return {number: np.zeros((*options.cell[::-1], 3), np.float32) for number in measured}

    monkeypatch.setattr(transfer_sheet, "read_chunks", lambda *_: frames)
    monkeypatch.setattr(transfer_sheet, "_cut_faces", filmed)
    signals = tmp_path / "signals.csv"
    rigs = [PlayedRig("anna", tmp_path, model), PlayedRig("ben", tmp_path, model)]
    heights = []
    for played in (rigs[:1], rigs):
        draw_transfer(tmp_path / "sheet.png", tmp_path / "film.mp4", signals, played)
        assert shown
        with Image.open(tmp_path / "sheet.png") as page:
            assert page.width > 350  # one picture wide, and its heading is whole
            heights.append(page.height)
    assert heights[1] - heights[0] == transfer_sheet.SHEET.cell[1]  # a row of pictures more


def test_brows_are_painted_where_they_are() -> None:
    model = small_model()
    points = builtin_template().points
    assert points is not None
    painted = PaintedFaces(model, points, replace(PAINT, size=(256, 256)))
    picture = painted.picture(model.skin.vertices).mean(axis=2)

    def dark(numbers: tuple[int, ...]) -> float:
        """Return the least light about landmarks."""
        known = points.select([str(number) for number in numbers if points.has(str(number))])
        places = painted.camera.project(known.at(model.skin.vertices), 256, 256)[:, :2]
        column, row = places.mean(axis=0).round().astype(int)
        return float(picture[row - 2 : row + 3, column - 2 : column + 3].min())

    forehead = dark((9, 8, 151, 108, 337))
    assert all(dark(brow) < 0.6 * forehead for brow in BROWS.values())
