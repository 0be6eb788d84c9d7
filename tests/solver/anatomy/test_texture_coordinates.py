"""Texture coordinates: charts packed into one image, and such as are made of a bare skin."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import trimesh

from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates, unwrap
from solver.errors import InputError
from solver.surface import Surface


def test_charts_are_packed_without_a_change_of_shape_or_side() -> None:
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    places = np.vstack([square * [1, 3], square * 0.5 + 7.0, square * 0.5 - 9.0])
    corners = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 9, 10], [NOWHERE] * 3])
    found = TextureCoordinates.packed(places, corners)
    assert found.places.min() >= 0.0
    assert found.places.max() <= 1.0
    assert found.mapped.tolist() == [0, 1, 2, 3, 4]
    at = found.places[found.corners[found.mapped]].astype(float)
    one = at[:, 1] - at[:, 0]
    other = at[:, 2] - at[:, 0]
    area = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    np.testing.assert_allclose(area / area[0], [1, 1, 1 / 12, 1 / 12, 1 / 12], rtol=1e-4)
    # the largest lies across; the small ones do not touch it or each other
    assert np.ptp(found.places[:4, 0]) > 0.98
    assert found.places[4:, 1].min() > found.places[:4, 1].max()
    assert abs(found.places[4:8, 0].mean() - found.places[8:, 0].mean()) > np.ptp(
        found.places[4:8, 0]
    )


def test_a_bare_skin_is_unwrapped_the_same_every_time() -> None:
    pytest.importorskip("xatlas")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=90.0)
    skin = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64))
    half = np.flatnonzero(skin.vertices[skin.faces, 0].min(axis=1) > 0.0)
    found = unwrap(skin, half)
    assert found.mapped.tolist() == half.tolist()
    assert found.places.min() >= 0.0
    assert found.places.max() <= 1.0
    assert unwrap(skin, half).sha256 == found.sha256


def test_without_xatlas_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(InputError, match="xatlas") as caught:
        unwrap(Surface(np.eye(3), np.array([[0, 1, 2]])), np.array([0]))
    assert caught.value.code == "texture.coordinates"
