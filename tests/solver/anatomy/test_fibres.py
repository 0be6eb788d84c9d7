"""Fibre directions on muscles whose fibres are known."""

import numpy as np
import pytest
import trimesh

from solver.anatomy.muscle_weights import fibre_directions, initial_weights, with_axis
from solver.anatomy.template import Muscle
from solver.anatomy.tetrahedra import background_grid, positively_oriented
from solver.surface import Surface
from solver.templates.bodyparts3d import with_table_axis


def flesh(lo, hi, spacing):
    vertices, tets = background_grid(np.array(lo, float), np.array(hi, float), spacing)
    return vertices, positively_oriented(vertices, tets)


def surface(mesh):
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))


def found(vertices, tets, muscle, least_share):
    """Return centres and directions where the muscle has at least a share of the tet."""
    weights = initial_weights(vertices, tets, [muscle.surface])
    directions = fibre_directions(vertices, tets, weights, (muscle,))
    entries = weights.tocoo()
    own = entries.col == 1
    assert not directions[~own].any()
    np.testing.assert_allclose(np.linalg.norm(directions[own], axis=1), 1, atol=1e-12)
    inside = own & (entries.data >= least_share)
    return vertices[tets].mean(axis=1)[entries.row[inside]], directions[inside]


def test_straight_muscle_runs_from_origin_to_insertion():
    vertices, tets = flesh([-30, -15, -15], [30, 15, 15], 4.0)
    box = trimesh.creation.box(extents=[40, 9, 9])
    box.apply_transform(trimesh.transformations.rotation_matrix(0.3, [0.2, 0, 1]))
    axis = box.vertices @ np.eye(3)[0]
    ends = [box.vertices[axis < 0].mean(axis=0), box.vertices[axis > 0].mean(axis=0)]
    fibre = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    muscle = Muscle("straight", surface(box), fibre, *ends)
    _, directions = found(vertices, tets, muscle, 0.5)
    assert (directions @ fibre).mean() > 0.97
    assert (directions @ fibre).min() > 0.8


@pytest.mark.long
def test_ring_runs_round_its_axis():
    vertices, tets = flesh([-30, -24, -10], [30, 24, 10], 3.0)
    ring = trimesh.creation.annulus(r_min=14, r_max=20, height=8, sections=48)
    ring.apply_scale([1.2, 0.9, 1])
    muscle = Muscle("ring", surface(ring), np.eye(3)[0], -np.eye(3)[0], np.eye(3)[0], ring=True)
    centres, directions = found(vertices, tets, muscle, 0.5)
    # On an ellipse the fibres follow its tangent, not the circle's.
    tangent = np.column_stack([-centres[:, 1] / 0.81, centres[:, 0] / 1.44, 0 * centres[:, 0]])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    along = np.sum(directions * tangent, axis=1)
    assert abs(along.mean()) > 0.95
    assert (along * np.sign(along.mean())).min() > 0.7


@pytest.mark.long
def test_muscle_that_bends_is_followed():
    """The third part of a ring, as the parts of orbicularis oculi are."""
    vertices, tets = flesh([-30, 8, -10], [30, 42, 10], 3.0)
    bar = trimesh.creation.box(extents=[2.0, 8, 8])
    for _ in range(4):
        bar = bar.subdivide()
    angle = bar.vertices[:, 0] * np.pi / 3
    radius = 32 + bar.vertices[:, 1]
    bent = np.column_stack([radius * np.sin(angle), radius * np.cos(angle), bar.vertices[:, 2]])
    low, high = (bent[sign * angle > 1].mean(axis=0) for sign in (-1, 1))
    muscle = Muscle("arc", Surface(bent, np.asarray(bar.faces)), np.eye(3)[0], low, high)
    centres, directions = found(vertices, tets, muscle, 0.5)
    tangent = np.column_stack([centres[:, 1], -centres[:, 0], 0 * centres[:, 0]])
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    assert np.sum(directions * tangent, axis=1).mean() > 0.93


@pytest.mark.long
def test_fibres_of_a_dome_do_not_fan_out():
    """Frontalis ends above in a wide arch, below in a straight border."""
    vertices, tets = flesh([-24, -4, -10], [24, 44, 10], 3.0)
    dome = trimesh.creation.cylinder(radius=18, height=7, sections=48).subdivide().subdivide()
    points = dome.vertices * [1, 0.5, 1] + [0, 30, 0]
    points[dome.vertices[:, 1] < 0, 1] = 30 + 1.6 * dome.vertices[dome.vertices[:, 1] < 0, 1]
    muscle = Muscle(
        "dome",
        Surface(points, np.asarray(dome.faces)),
        np.array([0.0, -1, 0]),
        np.array([0.0, 38, 0]),
        np.array([0.0, 2, 0]),
    )
    _, directions = found(vertices, tets, muscle, 0.5)
    assert (-directions[:, 1]).mean() > 0.98


@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_axes_of_known_muscles_come_from_the_table(side, sign):
    """Temporalis is longer from front to back than it is high: its fibres run down all the same."""
    ball = trimesh.creation.icosphere(3)
    fan = surface(ball.apply_scale([5, 40, 70]))
    muscle = with_table_axis(f"{side} temporalis", fan, np.zeros((1, 3)))
    assert muscle.fibre[1] < -0.8
    assert muscle.fibre[0] * sign < 0
    ring = with_table_axis(f"orbital part of {side} orbicularis oculi", fan, np.zeros((1, 3)))
    assert ring.ring


def test_unknown_muscle_runs_along_its_length_away_from_the_skull():
    bar = surface(trimesh.creation.box(extents=[5, 40, 5]).subdivide())
    muscle = with_axis("new", bar, np.array([[0.0, 30.0, 0.0]]))
    np.testing.assert_allclose(muscle.fibre, [0, -1, 0], atol=0.05)
