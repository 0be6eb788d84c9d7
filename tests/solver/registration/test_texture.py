"""Colours of a scan on its registered skin: a known pattern comes back, also where none is seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.template import Template
from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.meshio.colours import ScanColours, bilinear
from solver.meshio.paint import Paint
from solver.registration.texture import TEXTURE, Texture, bake
from solver.registration.topology import Topology, topology
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats, Ints
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.long
OPTIONS = replace(TEXTURE, size=1024)


def pattern(points: Floats) -> Floats:
    """Return colours (n, 3) that are the same on both sides of the mid-plane."""
    x = np.abs(points[:, 0])
    y = points[:, 1]
    z = points[:, 2]
    return 0.5 + 0.3 * np.sin(np.column_stack([x / 12, y / 15, z / 20]))


@pytest.fixture(scope="module")
def template() -> Template:
    return builtin_template()


@pytest.fixture(scope="module")
def known(template: Template) -> Topology:
    return topology(template)


def outer_faces(known: Topology) -> Ints:
    skin = known.template.skin
    is_outer = np.isin(np.arange(len(skin.vertices)), known.outer)
    return np.flatnonzero(is_outer[skin.faces].all(axis=1))


def scan(known: Topology, faces: Ints, motion: Similarity) -> ScanColours:
    """Return some faces of the template's skin with the pattern, where ``motion`` takes it from."""
    skin = known.template.skin
    paint = Paint.of_vertices(pattern(skin.vertices), len(faces))
    return ScanColours(motion.inverse()(skin.vertices), skin.faces[faces], paint)


def drawn(texture: Texture, template: Template, faces: Ints) -> tuple[Floats, Floats]:
    """Return the texture's colours and confidence in the middle of triangles, in [0, 1]."""
    coordinates = texture.coordinates
    own = coordinates.pixels(1)[coordinates.corners[faces]].mean(axis=1)
    image = np.dstack([texture.colours, texture.confidence])
    found = bilinear(image, own)
    return found[:, :3], found[:, 3]


def test_the_built_in_head_s_coordinates_fill_the_image_and_do_not_overlap(
    template: Template,
) -> None:
    coordinates = template.texture
    assert coordinates is not None
    places = coordinates.places
    assert places.min() >= 0.0
    assert places.max() <= 1.0
    assert np.ptp(places, axis=0).min() > 0.98
    corners = places[coordinates.corners[coordinates.mapped]].astype(float)
    one = corners[:, 1] - corners[:, 0]
    other = corners[:, 2] - corners[:, 0]
    area = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    assert (area > 0.0).all()  # none is mirrored
    # each texel's middle lies in one triangle: what they cover together is what each covers alone
    counts = np.zeros((512, 512))
    for triangle in 512 * corners:
        low = triangle.min(axis=0).astype(int)
        high = triangle.max(axis=0).astype(int) + 1
        columns, rows = (np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True))
        grid = np.stack(np.meshgrid(columns, rows), axis=-1)
        sides = np.roll(triangle, -1, axis=0) - triangle
        off = grid[..., None, :] - triangle
        inside = (sides[:, 0] * off[..., 1] - sides[:, 1] * off[..., 0] > 1e-9).all(axis=-1)
        counts[low[1] : high[1], low[0] : high[0]] += inside
    assert (counts > 1).sum() < 0.001 * (counts > 0).sum()


def test_the_template_s_hash_does_not_know_of_them(template: Template, tmp_path) -> None:
    bare = replace(template, texture=None)
    assert bare.sha256 == template.sha256
    assert bare.save(tmp_path / "bare.npz") == template.save(tmp_path / "whole.npz")
    assert Template.load(tmp_path / "bare.npz").texture is None
    loaded = Template.load(tmp_path / "whole.npz").texture
    assert loaded is not None
    assert template.texture is not None
    assert loaded.sha256 == template.texture.sha256


def test_a_known_pattern_comes_back(template: Template, known: Topology) -> None:
    motion = Similarity(10.0, np.eye(3)[[1, 2, 0]], np.array([5.0, -3.0, 40.0]))
    faces = outer_faces(known)
    coordinates = template.texture
    assert isinstance(coordinates, TextureCoordinates)
    seen = scan(known, faces, motion)
    texture = bake(seen, motion, template.skin, known, coordinates, OPTIONS)
    assert texture.figures["coverage"] > 0.95
    on_face = faces[np.isin(template.skin.faces[faces], known.face).all(axis=1)]
    colour, confidence = drawn(texture, template, on_face)
    middle = pattern(template.skin.vertices)[template.skin.faces[on_face]].mean(axis=1)
    sure = confidence > 0.9
    assert sure.mean() > 0.8
    assert np.abs(colour - middle)[sure].mean() < 0.01
    # the same scan wound inward
    turned = replace(seen, faces=seen.faces[:, ::-1])
    again = bake(turned, motion, template.skin, known, coordinates, OPTIONS)
    assert again.figures["coverage"] == pytest.approx(texture.figures["coverage"], abs=0.01)


def test_half_a_face_is_filled_from_the_other_side(template: Template, known: Topology) -> None:
    faces = outer_faces(known)
    skin = template.skin
    left = faces[(skin.vertices[skin.faces[faces], 0] > 0.0).all(axis=1)]
    coordinates = template.texture
    assert coordinates is not None
    texture = bake(scan(known, left, IDENTITY), IDENTITY, skin, known, coordinates, OPTIONS)
    assert 0.3 < texture.figures["coverage"] < 0.55
    assert texture.figures["mirrored"] > 0.3
    right = faces[(skin.vertices[skin.faces[faces], 0] < -10.0).all(axis=1)]
    right = right[np.isin(skin.faces[right], known.face).all(axis=1)]
    colour, confidence = drawn(texture, template, right)
    assert confidence.max() < 0.01
    middle = pattern(skin.vertices)[skin.faces[right]].mean(axis=1)
    assert np.abs(colour - middle).mean() < 0.05
    assert np.corrcoef(colour.ravel(), middle.ravel())[0, 1] > 0.95
