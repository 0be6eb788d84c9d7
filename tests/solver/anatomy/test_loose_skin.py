"""Skin beyond the flesh: it follows without a gap, and fades."""

from dataclasses import replace

import igl
import numpy as np

from solver.anatomy.embedding import LooseSkin
from solver.surface import Surface, vertex_areas
from tests.solver.block import head_block

NECK_MM = 240.0
STEP_MM = 5.0
FADE_MM = 60.0


def with_a_neck(model):
    """Return a model with a strip of skin on its lower edge, and a triangle that nothing holds."""
    skin = model.skin.vertices
    top = np.flatnonzero(skin[:, 1] == skin[:, 1].min())
    top = top[np.argsort(skin[top, 0])]
    rows = np.arange(STEP_MM, NECK_MM, STEP_MM)
    below = np.concatenate([skin[top] - [0.0, down, 0.0] for down in rows])
    number = np.vstack([top, len(skin) + np.arange(len(below)).reshape(len(rows), -1)])
    a = number[:-1, :-1]
    b = number[1:, :-1]
    c = number[1:, 1:]
    d = number[:-1, 1:]
    strip = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    vertices = np.vstack([skin, below, skin[:3] + 500.0])
    alone = len(vertices) - 3 + np.arange(3)
    surface = Surface(vertices, np.vstack([model.skin.faces, strip, alone]))
    return replace(model, skin=surface), number


def test_skin_follows_what_hangs_on_it_and_fades():
    """On a strip that all of one edge pulls, the displacement is exp(-s / l)."""
    model, number = with_a_neck(head_block())
    loose = LooseSkin(model)
    np.testing.assert_array_equal(loose.ids, np.sort(number[1:].ravel()))
    moved = np.tile([1.0, -20.0, 3.0], (len(model.skin.vertices), 1))
    found = np.zeros_like(model.skin.vertices)
    found[loose.ids] = loose.follow(moved)
    part = found[number[1:, number.shape[1] // 2]] / moved[0]
    np.testing.assert_allclose(part, part[:, :1] * np.ones(3), atol=1e-12)
    # each vertex has two edges to the next row: by rows the length is another one
    width = np.diff(np.unique(model.skin.vertices[number[0], 0]))[0]
    length = FADE_MM * np.sqrt(2.0 * STEP_MM / width)
    away = np.arange(STEP_MM, NECK_MM, STEP_MM)
    np.testing.assert_allclose(part[:, 0], np.exp(-away / length), atol=0.03)


def test_lashes_go_with_the_lid_they_touch(monkeypatch):
    """A strip from a vertex on flesh outwards, of no edge with it, moves as that vertex does."""
    model = head_block()
    skin = model.skin.vertices
    root = model.embedded[len(model.embedded) // 2]
    strip = skin[root] + np.array([[0.0, 0, 0.5], [1, 0, 0.5], [0, 0, 8], [1, 0, 8]])
    number = len(skin) + np.arange(4)
    faces = np.vstack([model.skin.faces, number[[0, 1, 2]], number[[1, 3, 2]]])
    lashed = replace(model, skin=Surface(np.vstack([skin, strip]), faces))
    last = len(faces) - np.arange(1, 3)
    monkeypatch.setattr("solver.anatomy.embedding.skin_parts", lambda _: {"lashes": last})
    loose = LooseSkin(lashed)
    np.testing.assert_array_equal(loose.ids, number)
    moved = np.zeros((len(lashed.skin.vertices), 3))
    moved[root] = [0.0, -8.0, 2.0]
    np.testing.assert_allclose(loose.follow(moved), np.tile([0.0, -8.0, 2.0], (4, 1)), atol=0.05)


def test_a_face_that_is_all_flesh_has_none():
    model = head_block()
    assert LooseSkin(model).follow(np.ones_like(model.skin.vertices)).shape == (0, 3)


def test_the_adjoint_of_following_is_its_transpose():
    model, _ = with_a_neck(head_block())
    loose = LooseSkin(model)
    random = np.random.default_rng(2)
    moved = random.standard_normal(model.skin.vertices.shape)
    forces = random.standard_normal((len(loose.ids), 3))
    pulled = loose.adjoint(forces)
    assert np.abs(pulled).max() > 0.1
    np.testing.assert_allclose((forces * loose.follow(moved)).sum(), (pulled * moved).sum())
    side_by_side = loose.follow(np.hstack([moved, 2.0 * moved]))
    np.testing.assert_allclose(side_by_side[:, 3:], 2.0 * loose.follow(moved))


def test_what_loose_skin_resists_is_the_energy_of_its_displacement():
    model, number = with_a_neck(head_block())
    loose = LooseSkin(model, fade_mm=FADE_MM, still=number[-1])
    skin = model.skin
    moved = np.zeros((len(skin.vertices), 1))
    moved[model.embedded] = 1.0
    moved[loose.ids] = loose.follow(moved)
    hangs = np.zeros(len(moved), bool)
    hangs[loose.ids] = True
    edges = igl.edges(skin.faces)
    edges = edges[hangs[edges].any(axis=1) & ~np.isin(edges, number[-1]).all(axis=1)]
    stretched = ((moved[edges[:, 0]] - moved[edges[:, 1]]) ** 2).sum()
    areas = vertex_areas(skin.vertices, skin.faces)
    held = (areas[loose.ids] * moved[loose.ids, 0] ** 2).sum() / FADE_MM**2
    resists = loose.resist(np.ones(len(loose.ids), bool))
    np.testing.assert_allclose(resists.sum(), stretched + held)
    assert np.count_nonzero(resists) == len(number[0])
    assert (loose.resist(np.zeros(len(loose.ids), bool)) == 0.0).all()
