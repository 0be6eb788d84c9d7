"""Scans of ICT-FaceKit subjects, against the sum written out by hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.templates.ict_facekit import ict_capture_set
from tests.fixtures import data_folder

SETS = {
    "subjects": {"B": {"identity_seed": 11}},
    "train": {"smile": {"mouthSmile_L": 0.9, "mouthSmile_R": 0.5}},
    "test": {"ah": {"jawOpen": 0.8}},
}


def write(path: Path, **changes: object) -> Path:
    path.write_text(json.dumps(SETS | changes))
    return path


def test_scans_are_neutral_plus_identity_plus_expression(tmp_path: Path) -> None:
    faces = data_folder("ict_facekit")
    captures = ict_capture_set(faces, "B", write(tmp_path / "sets.json"))
    with np.load(faces / "ict_facekit.npz") as data:
        names = list(data["ex"])
        coefficients = np.random.default_rng(11).standard_normal(100)
        neutral = data["V"] + sum(
            c * shape for c, shape in zip(coefficients, data["I"], strict=True)
        )
        left, right = (data["E"][names.index(f"mouthSmile_{side}")] for side in "LR")
    np.testing.assert_allclose(captures.neutral.vertices, 10 * neutral, atol=1e-3)
    np.testing.assert_allclose(
        captures.train["smile"].vertices, 10 * (neutral + 0.9 * left + 0.5 * right), atol=1e-3
    )
    assert list(captures.test) == ["ah"]
    assert captures.first(1, 0).test == {}


@pytest.mark.parametrize(
    ("subject", "changes", "code"),
    [
        ("D", {}, "captures.subject"),
        ("B", {"train": {"wink": {"wink_L": 1}}}, "captures.expression"),
    ],
)
def test_what_is_not_there_is_named(
    subject: str, changes: dict[str, object], code: str, tmp_path: Path
) -> None:
    path = write(tmp_path / "sets.json", **changes)
    with pytest.raises(InputError) as caught:
        ict_capture_set(data_folder("ict_facekit"), subject, path)
    assert caught.value.code == code


@pytest.mark.parametrize("text", ["[]", "{", '{"subjects": {}}'])
def test_another_file_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "sets.json").write_text(text)
    with pytest.raises(InputError) as caught:
        ict_capture_set(tmp_path, "A", tmp_path / "sets.json")
    assert caught.value.code == "captures.unreadable"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"subjects": {"B": {"seed": 3}}}, "subject B has no identity_seed"),
        ({"subjects": {"B": {"identity_seed": -1}}}, "a whole number from 0"),
        ({"train": ["smile"]}, "train is not an object of objects"),
        ({"test": {"ah": {"jawOpen": "much"}}}, "the weight of jawOpen is not a number"),
        ({"test": {"smile": {"jawOpen": 0.1}}}, "smile is both in train and in test"),
    ],
)
def test_what_has_another_form_is_named(
    changes: dict[str, object], words: str, tmp_path: Path
) -> None:
    path = write(tmp_path / "sets.json", **changes)
    with pytest.raises(InputError, match=words):
        ict_capture_set(tmp_path, "B", path)
