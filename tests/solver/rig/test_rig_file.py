"""``rig.npz``: a fitted person in one file, read as the files of the release before were."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError, make_warning
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel
from solver.rig.report import weights_hash
from solver.rig.result import (
    ExpressionFit,
    load_activations,
    load_weights,
    save_activations,
    save_weights,
)
from solver.rig.rig import Rig
from tests.solver.block import block_model


@pytest.fixture
def rig() -> Rig:
    model = block_model()
    skin = model.skin.vertices + 0.5
    a = np.tile(IDENTITY, (model.muscle_count, 1))
    error = np.full(len(skin), np.nan)
    fit = ExpressionFit(
        "smile", "train", a, np.arange(5.0), skin, skin, error, 0, 3, 0.5, 0.1, x=model.rest + 0.25
    )
    notice = make_warning("model.odd", "something is odd")
    return Rig(model, model.weights, (fit,), {"fit": 1.5}, (notice,), {"verdict": "good"})


def check_same(one: Rig, other: Rig) -> None:
    assert one.model.sha256 == other.model.sha256
    assert weights_hash(one.weights) == weights_hash(other.weights)
    for before, after in zip(one.expressions, other.expressions, strict=True):
        assert (before.name, before.iterations) == (after.name, after.iterations)
        np.testing.assert_array_equal(before.activations, after.activations)
        np.testing.assert_array_equal(before.jaw, after.jaw)
        np.testing.assert_array_equal(before.x, after.x)
        np.testing.assert_allclose(before.skin, after.skin, atol=1e-5)
    assert one.figures == other.figures


def test_a_rig_comes_back_from_its_file_and_from_its_folder(rig: Rig, tmp_path: Path) -> None:
    rig.save(tmp_path / "rig.npz")
    for path in (tmp_path / "rig.npz", tmp_path):
        found = Rig.load(path)
        check_same(rig, found)
        assert (found.seconds, found.notices) == (rig.seconds, rig.notices)


def test_a_folder_of_the_release_before_is_a_rig(rig: Rig, tmp_path: Path) -> None:
    rig.model.save(tmp_path / "model.npz")
    save_weights(tmp_path / "muscle_weights.npz", rig.weights, rig.model)
    save_activations(tmp_path / "activations.npz", rig.expressions, rig.model)
    check_same(replace(rig, figures=None), Rig.load(tmp_path))
    (tmp_path / "report.json").write_text('{"verdict": "good"}')
    check_same(rig, Rig.load(tmp_path))


def test_the_file_is_read_wherever_one_of_its_parts_is_asked_for(rig: Rig, tmp_path: Path) -> None:
    file = tmp_path / "rig.npz"
    rig.save(file)
    model = SubjectModel.load(file)
    assert model.sha256 == rig.model.sha256
    assert weights_hash(load_weights(file, rig.model)) == weights_hash(rig.weights)
    assert load_activations(file, rig.model)[0].name == "smile"
    other = replace(rig.model, rest=rig.model.rest + 1.0)
    with pytest.raises(InputError) as raised:
        load_weights(file, other)
    assert raised.value.code == "rig.model"


def test_what_is_no_rig_is_refused(rig: Rig, tmp_path: Path) -> None:
    rig.model.save(tmp_path / "model.npz")
    save_weights(tmp_path / "muscle_weights.npz", rig.weights, rig.model)
    junk = shutil.copy(__file__, tmp_path / "junk.npz")
    for path in (tmp_path, tmp_path / "model.npz", tmp_path / "muscle_weights.npz", Path(junk)):
        with pytest.raises(InputError) as raised:
            Rig.load(path)
        assert raised.value.code == "rig.unreadable"
