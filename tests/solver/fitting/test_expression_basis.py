"""The template's expressions on a face: solved once, kept, and of no other face."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face
from tests.fixtures import small_capture, small_model


@pytest.fixture(scope="module")
def face() -> Face:
    return Face(small_model())


@pytest.fixture(scope="module")
def shapes() -> np.ndarray:
    rest = small_capture("neutral").vertices
    ah = small_capture("ah").vertices - rest
    return np.stack([ah, 0.02 * ah])


@pytest.fixture(scope="module")
def basis(face: Face, shapes: np.ndarray) -> ExpressionBasis:
    return ExpressionBasis.solve(face, shapes)


def test_what_was_kept_is_read(
    face: Face, shapes: np.ndarray, basis: ExpressionBasis, tmp_path: Path
) -> None:
    file = tmp_path / "expression_basis.npz"
    basis.save(file, face)
    read = ExpressionBasis.load(file, face, shapes)
    assert read is not None
    assert [len(each) for each in read.changes] == [len(each) for each in basis.changes]
    for one, other in zip(read.changes, basis.changes, strict=True):
        assert np.abs(other).max() > 1e-3
        np.testing.assert_array_equal(one, other)


def test_of_another_face_drive_or_shape_nothing_is_read(
    face: Face, shapes: np.ndarray, basis: ExpressionBasis, tmp_path: Path
) -> None:
    file = tmp_path / "expression_basis.npz"
    basis.save(file, face)
    assert (
        ExpressionBasis.load(file, face.driven_by(Admissible(AdmissibleLimits())), shapes) is None
    )
    assert ExpressionBasis.load(file, face, shapes[:1]) is None
    assert ExpressionBasis.load(file, face, 1.01 * shapes) is None
    file.write_bytes(b"PK")
    with pytest.raises(InputError) as caught:
        ExpressionBasis.load(file, face, shapes)
    assert caught.value.code == "basis.unreadable"
