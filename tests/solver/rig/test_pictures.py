"""Pictures of a rig: what they show, a page and its data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from solver.drawing.sheet import HEADER
from solver.model import SubjectModel
from solver.rig import ExpressionFit
from solver.rig.pictures import anatomy_picture, fit_picture, tets_picture
from tests.fixtures import small_capture, small_model

CELL = (1600 // 3, 520)


@pytest.fixture(scope="module")
def model() -> SubjectModel:
    return small_model()


@pytest.mark.long
def test_fit_picture_shows_scan_fit_and_where_they_differ(
    model: SubjectModel, tmp_path: Path
) -> None:
    scan = small_capture("smile").vertices
    error = np.full(len(scan), np.nan)
    error[model.face] = 0.0
    exact = ExpressionFit(
        "smile",
        "train",
        np.zeros((model.muscle_count, 6)),
        np.zeros(5),
        scan,
        scan,
        error,
        0,
        1,
        0.1,
        0.0,
    )
    chin = model.skin.vertices[model.face, 1] < np.quantile(model.skin.vertices[model.face, 1], 0.2)
    wrong = error.copy()
    wrong[model.face[chin]] = 5.0
    pages = []
    for name, fit in (("exact", exact), ("wrong", replace(exact, error_mm=wrong))):
        path = tmp_path / f"{name}.png"
        fit_picture(model, fit, path)
        assert path.stat().st_size < 1_000_000
        pages.append(np.asarray(Image.open(path)).astype(int))
    width, height = CELL
    first, second, third = (
        pages[0][HEADER + 30 : HEADER + height, k * width : (k + 1) * width] for k in range(3)
    )
    np.testing.assert_array_equal(first, second)
    red = (third[..., 0] - third[..., 2]).max()
    wrong_third = pages[1][HEADER + 30 : HEADER + height, 2 * width : 3 * width]
    is_red = (wrong_third[..., 0] - wrong_third[..., 2]) > 60
    assert red < 40
    assert is_red[height // 2 :].sum() > 2000
    assert is_red[: height // 2].sum() == 0


@pytest.mark.slow
def test_anatomy_and_tets_pictures_are_the_same_every_time(
    model: SubjectModel, tmp_path: Path
) -> None:
    for draw in (anatomy_picture, tets_picture):
        paths = [tmp_path / f"{draw.__name__}_{k}.png" for k in range(2)]
        for path in paths:
            draw(model, path)
        assert paths[0].read_bytes() == paths[1].read_bytes()
        assert len(np.unique(np.asarray(Image.open(paths[0])).reshape(-1, 3), axis=0)) > 5000
