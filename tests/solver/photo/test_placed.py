"""What is told of cameras that were placed in one world and contradict."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.photo.camera import PinholeCamera
from solver.photo.expression import ExpressionOptions, fit_expression
from solver.photo.mesh_points import landmark_points
from solver.photo.photo import Photo
from solver.photo.placed import Reprojection, find_contradiction, reprojections
from solver.templates.builtin.build import builtin_template
from solver.tracks.basis import MuscleTracks
from solver.tracks.plain import PlainFace
from solver.tracks.shapes import template_shapes
from tests.fixtures import small_model

MODEL = small_model()
POINTS = landmark_points(builtin_template())
OPTIONS = ExpressionOptions(shading=None)
NOISE_PX = 2.0


@cache
def face() -> PlainFace:
    basis = builtin_template().shapes
    assert basis is not None
    shapes = template_shapes(MODEL, basis)
    names = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "mouthPucker")
    return PlainFace(MODEL, MuscleTracks.of(MODEL, {name: shapes[name] for name in names}))


def camera(yaw: float) -> PinholeCamera:
    turn = Rotation.from_euler("xy", [3.0, yaw], degrees=True).as_matrix()
    rotation = np.diag([1.0, -1.0, -1.0]) @ turn
    middle = MODEL.skin.vertices[MODEL.face].mean(axis=0)
    shift = np.array([2.0, 3.0, 700.0]) - rotation @ middle
    return PinholeCamera(np.full(2, 1000.0), np.array([200.0, 250.0]), rotation, shift)


def photograph(name: str, yaw: float, given: PinholeCamera | None = None) -> Photo:
    """Return the landmarks of the face at rest, by a camera that may be ``given`` wrongly."""
    random = np.random.default_rng(abs(int(yaw)))
    places = camera(yaw).project(POINTS.at(MODEL.skin.vertices))[:, :2]
    places = places + NOISE_PX * random.standard_normal(places.shape)
    marks = {n: place for n, place in zip(POINTS.names, places, strict=True) if n.isdigit()}
    pixels = np.zeros((500, 400, 3), np.float32)
    return Photo(name, pixels, given or camera(yaw), landmarks=marks, is_placed=True)


def moment(*photos: Photo) -> dict[str, Reprojection]:
    """Fit the photographs of a moment; return how far their landmarks are off."""
    end = fit_expression(face(), photos, POINTS, options=OPTIONS).landmarks.point
    return reprojections(face(), photos, POINTS, end, OPTIONS)


def turned(given: PinholeCamera, degrees: float) -> PinholeCamera:
    """Return a camera that has turned about its axis."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return replace(given, rotation=turn @ given.rotation, translation=turn @ given.translation)


def shifted(given: PinholeCamera, mm: float) -> PinholeCamera:
    """Return a camera that is somewhat higher."""
    return replace(given, translation=given.translation + np.array([0.0, mm, 0.0]))


def test_cameras_that_agree_are_not_told() -> None:
    found = moment(photograph("left", 25.0), photograph("right", -25.0))
    assert found.keys() == {"left", "right"}
    for each in found.values():
        assert 1.0 < each.alone_px < each.given_px + 0.05
        assert each.given_px < each.alone_px + 0.3
    assert find_contradiction(found) == []


@pytest.mark.parametrize(
    "wrong",
    [
        turned(camera(-25.0), 15.0),
        shifted(camera(-25.0), 10.0),
        replace(camera(-25.0), focal=1.2 * camera(-25.0).focal),
        camera(25.0),
    ],
)
def test_cameras_that_contradict_are_told_with_every_photograph_s_reprojection(
    wrong: PinholeCamera,
) -> None:
    found = moment(photograph("left", 25.0), photograph("right", -25.0, given=wrong))
    (finding,) = find_contradiction(found)
    assert finding.code == "photo.cameras"
    assert finding.context["photos"].keys() == {"left", "right"}
    assert finding.context["photos"]["right"]["given_px"] > 4.0
    assert "left" in finding.message


def test_one_placed_camera_contradicts_nobody() -> None:
    free = replace(photograph("free", -25.0), camera=None, is_placed=False)
    assert moment(photograph("left", 25.0), free) == {}
