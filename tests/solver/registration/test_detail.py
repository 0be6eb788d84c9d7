"""Detail of a scan on its registered skin: what was carved comes back, what was not does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from solver.anatomy.template import Template
from solver.anatomy.texture_coordinates import NOWHERE, TextureCoordinates
from solver.errors import InputError
from solver.registration.detail import DETAIL, Detail, bake_detail, mesh_axes
from solver.registration.normal_maps import read_normals
from solver.registration.scan_noise import quieten
from solver.registration.subdivided import CHILDREN, Subdivided
from solver.registration.topology import Topology, topology
from solver.registration.wrinkles import wrinkles
from solver.surface import Floats, Surface, faces_within, part_of, unit_rows, vertex_normals
from solver.templates.builtin.build import builtin_template

pytestmark = pytest.mark.long
OPTIONS = replace(DETAIL, size=512)
LEVELS = 3  # of the scan
HEIGHT = 60.0  # mm over the nose's tip, of a furrow across the forehead
RADIUS = 1.5
DEPTH = 0.4


@pytest.fixture(scope="module")
def template() -> Template:
    return builtin_template()


@pytest.fixture(scope="module")
def known(template: Template) -> Topology:
    return topology(template)


@pytest.fixture(scope="module")
def head(template: Template, known: Topology) -> Surface:
    """Return the face, divided finely."""
    fine = Subdivided.of(template.skin, LEVELS).surface
    on_face = np.repeat(faces_within(template.skin.faces, known.face), CHILDREN**LEVELS)
    return part_of(fine, np.flatnonzero(on_face))


def forehead(template: Template, points: Floats) -> Floats:
    """Return how far (n,) points are over the furrow, NaN beyond the forehead's middle."""
    tip = template.skin.vertices[template.skin.vertices[:, 2].argmax()]
    x, y, z = (points - tip).T
    return np.where((np.abs(x) < 30.0) & (z > -60.0), y - HEIGHT, np.nan)


def carved(template: Template, head: Surface, heights: Floats | None = None) -> Surface:
    """Return a head with a furrow, or with these heights (n,)."""
    if heights is None:
        off = np.nan_to_num(forehead(template, head.vertices), nan=1e3)
        heights = -DEPTH * np.exp(-((off / RADIUS) ** 2))
    return head.with_vertices(head.vertices + heights[:, None] * vertex_normals(head))


def baked(scan: Surface, known: Topology, coordinates: TextureCoordinates | None = None) -> Detail:
    template = known.template
    places = coordinates or template.texture
    assert places is not None
    found = bake_detail(scan, template.skin, known, places, OPTIONS)
    assert found is not None
    return found


def in_space(detail: Detail) -> Floats:
    """Return the normals (t, 3) of a detail in space, by the axes that a viewer makes."""
    every = np.arange(len(detail.texels.rows))
    axes = mesh_axes(detail.texels, every, detail.coordinates)
    return np.asarray(np.einsum("ni,nij->nj", detail.normals, axes))


def two_charts(template: Template, known: Topology) -> TextureCoordinates:
    """Return the face from the front in two charts, cut in the middle, the right one mirrored."""
    skin = template.skin
    front = vertex_normals(skin)[:, 2] > 0.3
    own = np.flatnonzero(faces_within(skin.faces, known.face) & front[skin.faces].all(axis=1))
    x, y, _ = skin.vertices.T
    place = np.column_stack([x, y - y[known.face].min()]) / 250.0
    is_left = skin.vertices[skin.faces[own]].mean(axis=1)[:, 0] > 0.0
    mirrored = place * np.array([-1.0, 1.0])
    places = np.vstack([place + np.array([0.05, 0.1]), mirrored + np.array([0.55, 0.1])])
    corners = np.full(skin.faces.shape, NOWHERE, np.int32)
    corners[own] = skin.faces[own] + np.where(is_left, 0, len(skin.vertices))[:, None]
    return TextureCoordinates(places.astype(np.float32), corners)


def test_a_furrow_comes_back_where_it_is_and_as_deep(
    template: Template, known: Topology, head: Surface, tmp_path
) -> None:
    detail = baked(carved(template, head), known)
    off = forehead(template, detail.texels.at(template.skin.vertices))
    bottom = np.abs(off) < 0.3
    assert detail.heights[bottom].mean() == pytest.approx(-DEPTH, rel=0.2)
    beside = (np.abs(off) > 5.0) & (np.abs(off) < 15.0)
    assert np.abs(detail.heights[beside]).mean() < 0.1 * DEPTH
    # its walls: the upper one looks down, the lower one up
    turned = (
        in_space(detail)[:, 1] - unit_rows(detail.texels.at(vertex_normals(template.skin)))[:, 1]
    )
    steepest = np.sqrt(2.0 / np.e) * DEPTH / RADIUS
    for side in (1.0, -1.0):
        wall = np.abs(off - side * RADIUS / np.sqrt(2.0)) < 0.3
        assert -side * turned[wall].mean() > 0.6 * steepest
    images = tmp_path / "normals.png", tmp_path / "displacement.png"
    detail.write(*images)
    numbers = np.asarray(Image.open(images[1])).astype(np.float64)
    told = detail.figures["displacement"]
    found = (told["offset_mm"] + told["scale_mm"] * numbers)[
        detail.texels.rows, detail.texels.columns
    ]
    np.testing.assert_allclose(found, detail.heights, atol=2e-5)
    read = read_normals(images[0], detail.texels, detail.coordinates)
    assert np.abs(read - detail.normals).max() < 0.02
    other = replace(detail.coordinates, places=detail.coordinates.places * np.float32(0.5))
    with pytest.raises(InputError) as caught:
        read_normals(images[0], detail.texels, other)
    assert caught.value.code == "texture.template"


def test_a_smooth_error_of_registration_is_no_skin(
    template: Template, known: Topology, head: Surface
) -> None:
    x, y, _ = head.vertices.T
    error = 0.5 * np.sin(x / 15.0) * np.cos(y / 15.0)
    detail = baked(carved(template, head, error), known)
    own = detail.texels.within(known.face)
    assert np.abs(detail.heights[own]).mean() < 0.1 * np.abs(error).mean()
    assert detail.figures["displacement"]["p95_mm"] < 0.15


def test_noise_is_no_skin(template: Template, known: Topology, head: Surface) -> None:
    noise = 0.05 * np.random.default_rng(1).standard_normal(len(head.vertices))
    rough = carved(template, head, noise)
    assert quieten(rough, np.arange(len(noise))).noise_mm == pytest.approx(0.05, rel=0.1)
    detail = baked(rough, known)
    own = detail.texels.within(known.face)
    assert np.abs(detail.heights[own]).mean() < 0.1 * np.abs(noise).mean()
    turned = np.degrees(np.arccos(np.clip(detail.normals[own, 2], -1.0, 1.0)))
    raw = np.einsum("nd,nd->n", vertex_normals(rough), vertex_normals(head))
    assert turned.mean() < 0.1 * np.degrees(np.arccos(np.clip(raw, -1.0, 1.0))).mean()


def test_a_coarse_scan_has_none(template: Template, known: Topology) -> None:
    coordinates = template.texture
    assert coordinates is not None
    assert bake_detail(template.skin, template.skin, known, coordinates, OPTIONS) is None


def test_mirrored_charts_and_seams_show_the_same_skin(
    template: Template, known: Topology, head: Surface
) -> None:
    scan = carved(template, head)
    detail = baked(scan, known, two_charts(template, known))
    texels = detail.texels
    off = forehead(template, texels.at(template.skin.vertices))
    is_left = detail.coordinates.corners[texels.faces, 0] < len(template.skin.vertices)
    plain = unit_rows(texels.at(vertex_normals(template.skin)))
    turned = in_space(detail) - plain
    steepest = np.sqrt(2.0 / np.e) * DEPTH / RADIUS
    for chart in (is_left, ~is_left):
        for side in (1.0, -1.0):
            wall = chart & (np.abs(off - side * RADIUS / np.sqrt(2.0)) < 0.5)
            assert -side * turned[wall, 1].mean() > 0.5 * steepest
            # the image's upper edge is up in both
            assert -side * detail.normals[wall, 1].mean() > 0.5 * steepest
    # at places of the seam both charts have the same height and the same normal in space
    places = texels.at(template.skin.vertices)
    near = np.flatnonzero((np.abs(places[:, 0]) < 0.5) & (np.abs(off) < 6.0))
    ours = near[is_left[near]]
    theirs = near[~is_left[near]]
    assert len(ours) > 10
    apart = np.linalg.norm(places[ours][:, None] - places[theirs], axis=2)
    pair = theirs[apart.argmin(axis=1)]
    close = apart.min(axis=1) < 0.4
    assert close.sum() > 5
    assert np.abs(detail.heights[ours] - detail.heights[pair])[close].mean() < 0.1 * DEPTH
    space = in_space(detail)
    assert np.abs(space[ours] - space[pair])[close].mean() < 0.05


def test_wrinkles_are_what_an_expression_adds(
    template: Template, known: Topology, head: Surface
) -> None:
    smooth = baked(carved(template, head, np.zeros(len(head.vertices))), known)
    furrowed = baked(carved(template, head), known)
    found = wrinkles(furrowed, smooth.normals, known)
    off = forehead(template, furrowed.texels.at(template.skin.vertices))
    assert found.mask[np.abs(off) < 1.0].mean() > 0.5
    chin = furrowed.texels.within(template.regions["chin"])
    assert found.mask[chin].mean() < 0.05
    assert found.figures["regions"]["forehead"] > 0.03
    # and against itself nothing is added
    none = wrinkles(furrowed, furrowed.normals, known)
    assert none.mask.max() < 0.01
