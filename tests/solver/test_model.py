"""A subject model on disk: it comes back whole, and what is none is refused."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.model import CondyleTracks, Expressions, SubjectModel, by_muscle, find_muscles
from solver.surface import Surface
from tests.solver.block import block_model, divided_block


def test_a_model_comes_back_as_it_was(tmp_path: Path) -> None:
    model = block_model()
    model.save(tmp_path / "model.npz")
    found = SubjectModel.load(tmp_path / "model.npz")
    assert found.muscle_names == model.muscle_names
    for field in ("rest", "tets", "cranium", "mandible", "embedded", "offset", "face"):
        np.testing.assert_array_equal(getattr(found, field), getattr(model, field))
    for field in ("weights", "embedding"):
        kept = getattr(model, field)
        read = getattr(found, field)
        np.testing.assert_array_equal(read.indices, kept.indices)
        np.testing.assert_array_equal(read.data, kept.data)


def test_a_name_of_a_whole_muscle_means_its_parts_and_a_wrong_one_is_told_the_near() -> None:
    names = ("zygo_l.inferior", "zygo_l.superior", "risorius_l")
    wholes = ("zygo_l", "zygo_l", "risorius_l")
    model = replace(block_model(), muscle_names=names, wholes=wholes)
    assert model.muscle_numbers("zygo_l").tolist() == [0, 1]
    assert model.muscle_numbers("zygo_l.superior").tolist() == [1]
    assert model.muscle_number("risorius_l") == 2
    with pytest.raises(InputError, match="name one, or take all"):
        model.muscle_number("zygo_l")
    parts = "zygo_l has the parts zygo_l.inferior, zygo_l.superior"
    for wrong, words in (
        ("zygo_r", parts),
        ("zygo", parts),
        ("risorius", "did you mean risorius_l?"),
        ("brow", "it has zygo_l, risorius_l"),
    ):
        with pytest.raises(InputError, match=re.escape(words)) as caught:
            model.muscle_numbers(wrong)
        assert caught.value.code == "model.muscle"


def test_compartments_and_their_wholes_come_back(tmp_path: Path) -> None:
    model = divided_block()
    model.save(tmp_path / "model.npz")
    found = SubjectModel.load(tmp_path / "model.npz")
    assert found.sha256 == model.sha256
    assert found.muscle_groups == ("left", "left", "right", "right")
    whole = block_model()
    assert whole.muscle_groups == whole.muscle_names == ("left", "right")
    assert "wholes" not in whole.archive().header  # older models keep their hash


def test_expressions_come_back(tmp_path: Path) -> None:
    whole = block_model()
    motions = np.arange(6.0 * len(whole.face), dtype=np.float32).reshape(2, -1, 3)
    model = replace(whole, expressions=Expressions(("smile", "frown"), motions))
    model.save(tmp_path / "model.npz")
    found = SubjectModel.load(tmp_path / "model.npz").expressions
    assert found is not None
    assert found.names == ("smile", "frown")
    np.testing.assert_array_equal(found.motions, motions)
    assert model.sha256 != whole.sha256
    assert "expressions" not in whole.archive().header  # older models keep their hash


def test_tracks_of_the_condyles_come_back(tmp_path: Path) -> None:
    older = block_model()
    tracks = CondyleTracks(0.6, 60.0, 20.0, 0.9)
    model = replace(older, jaw=replace(older.jaw, tracks=tracks))
    model.save(tmp_path / "model.npz")
    assert SubjectModel.load(tmp_path / "model.npz").jaw.tracks == tracks
    assert "condyle_tracks" not in older.archive().header


def test_a_compartment_has_the_part_of_the_surface_around_it() -> None:
    low, high = (np.array([[0.0, y, 5], [9, y, 5], [9, y, 9]]) for y in (5.0, 35.0))
    sheet = Surface(np.vstack([low, high]), np.array([[0, 1, 2], [3, 4, 5]]))
    found = replace(divided_block(), muscles={"left": sheet}).muscle_surfaces
    np.testing.assert_array_equal(found["left.lower"].vertices, low)
    np.testing.assert_array_equal(found["left.upper"].vertices, high)


def test_the_name_of_a_whole_muscle_means_its_parts() -> None:
    names = ("frontalis_l.medial", "frontalis_l.lateral.1", "frontalis_lower", "frontalis_r")
    assert find_muscles("frontalis_l", names) == [0, 1]
    assert find_muscles("frontalis_r", names) == [3]
    assert find_muscles("frontalis", names) == []
    given = {"frontalis_l.medial": 1, "frontalis_l": 2, "procerus": 3}
    assert by_muscle(given, names) == {"frontalis_l.medial": 1, "frontalis_l.lateral.1": 2}


@pytest.mark.parametrize("content", ["nothing", "text", "cut zip", "array", "other header"])
def test_what_is_no_model_is_refused(content: str, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    with path.open("wb") as stream:
        if content == "array":
            np.save(stream, np.zeros(3))
        elif content == "other header":
            np.savez(stream, header=np.frombuffer(b"[1]", np.uint8))
        else:
            stream.write({"nothing": b"", "text": b"v 0 0 0", "cut zip": b"PK\3\4cut"}[content])
    with pytest.raises(InputError) as caught:
        SubjectModel.load(path)
    assert caught.value.code == "model.unreadable"
    assert caught.value.context["file"] == "model.npz"
