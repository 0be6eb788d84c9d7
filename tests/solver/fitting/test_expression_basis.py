"""The template's expressions on a face: solved once, kept, and of no other face."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.activation import rest_curvature
from solver.fitting.drives.admissible import Admissible, AdmissibleLimits
from solver.fitting.expression_basis import LINEAR, ExpressionBasis, begin_at, follows_teeth
from solver.fitting.face import Face, PosedFace
from solver.fitting.simplex import mix_by_stiffness
from solver.model import CondyleTracks
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


def test_a_basis_leaves_what_is_kept_for_the_face(shapes: np.ndarray) -> None:
    tracks = CondyleTracks(slope=0.6, apart=100.0, length=20.0, opening=0.7)
    model = small_model()
    face = Face(replace(model, jaw=replace(model.jaw, tracks=tracks))).with_jaw_on_tracks()
    assert follows_teeth(face)
    before = rest_curvature(face).copy()
    ExpressionBasis.solve(face, shapes, LINEAR)
    np.testing.assert_array_equal(rest_curvature(face), before)


@pytest.mark.long
def test_a_fit_begins_half_way_where_the_whole_change_is_worse(
    face: Face, basis: ExpressionBasis
) -> None:
    """As it is where the lips would go through each other."""
    change = basis.whole[0]

    def value_with_least_at(part: float) -> Callable[[PosedFace], float]:
        there = face.rest_pose().add(part * change).vector()
        return lambda state: float(np.sum((state.pose.vector() - there) ** 2))

    for least, part in ((1.0, 1.0), (0.6, 0.5), (0.3, 0.5)):
        state = begin_at(face, change, value_with_least_at(least))
        assert state is not None
        expected = face.rest_pose().add(part * change).vector()
        np.testing.assert_allclose(state.pose.vector(), expected)


@pytest.mark.long
def test_what_was_kept_is_read(
    face: Face, shapes: np.ndarray, basis: ExpressionBasis, tmp_path: Path
) -> None:
    file = tmp_path / "expression_basis.npz"
    basis.save(file, face)
    read = ExpressionBasis.load(file, face, shapes)
    assert [len(each) for each in read.changes] == [len(each) for each in basis.changes]
    for one, other in zip(read.changes, basis.changes, strict=True):
        assert np.abs(other).max() > 1e-3
        np.testing.assert_array_equal(one, other)


def test_of_another_face_drive_or_shape_nothing_is_read(
    face: Face, shapes: np.ndarray, basis: ExpressionBasis, tmp_path: Path
) -> None:
    file = tmp_path / "expression_basis.npz"
    basis.save(file, face)
    limited = face.driven_by(Admissible(AdmissibleLimits()))
    other = Face(replace(face.model, muscle_names=face.model.muscle_names[::-1]))
    for asked, wanted, reason in (
        (limited, shapes, "other controls or limits"),
        (other, shapes, "another person"),
        (face.with_weights(mix_by_stiffness(face.S, 3.0)), shapes, "another muscle geometry"),
        (face, shapes[:1], "other expressions"),
        (face, 1.01 * shapes, "other expressions"),
    ):
        with pytest.raises(InputError, match=reason) as caught:
            ExpressionBasis.load(file, asked, wanted)
        assert caught.value.code == "basis.other"
    file.write_bytes(b"PK")
    with pytest.raises(InputError) as caught:
        ExpressionBasis.load(file, face, shapes)
    assert caught.value.code == "basis.unreadable"
