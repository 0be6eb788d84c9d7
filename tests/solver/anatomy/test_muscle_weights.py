import numpy as np
import pytest
import trimesh

from solver.anatomy.muscle_weights import (
    CANDIDATE_MM,
    enclosed_volume,
    initial_weights,
    muscle_volumes,
)
from solver.anatomy.tetrahedra import background_grid
from solver.surface import Surface


def box(lo, hi):
    lo = np.array(lo, float)
    hi = np.array(hi, float)
    mesh = trimesh.creation.box(extents=hi - lo)
    return Surface(np.asarray(mesh.vertices) + (lo + hi) / 2, np.asarray(mesh.faces, np.int64))


def tilted(surface):
    """Turn a box so that its faces cut the grid's cells at different heights."""
    turn = trimesh.transformations.rotation_matrix(0.5, [1, 2, 0.3], surface.vertices.mean(axis=0))
    return surface.with_vertices(trimesh.transform_points(surface.vertices, turn))


@pytest.fixture
def flesh():
    return background_grid(np.zeros(3), np.array([60.0, 30.0, 30.0]), 6.0)


def test_volumes_are_kept_and_rows_sum_to_one(flesh):
    muscles = [tilted(box([3, 4, 5], [20, 25, 20])), tilted(box([40, 10, 10], [44, 20, 14]))]
    weights = initial_weights(*flesh, muscles)
    assert np.allclose(weights.sum(axis=1), 1)
    assert weights.data.min() >= 0
    kept = muscle_volumes(*flesh, weights)
    assert kept[0] == pytest.approx(17 * 21 * 15, rel=0.03)
    assert kept[1] == pytest.approx(4 * 10 * 4, rel=0.05)


def test_candidates_are_the_tets_within_reach(flesh):
    vertices, tets = flesh
    weights = initial_weights(vertices, tets, [box([0, 0, 0], [12, 30, 30])])
    stored = np.diff(weights.indptr) == 2
    nearest = vertices[tets][:, :, 0].min(axis=1)
    assert stored[nearest < 12 + CANDIDATE_MM].all()
    assert not stored[nearest > 12 + CANDIDATE_MM].any()
    assert (weights.data == 0).any()
    assert (weights.indices[weights.indptr[:-1]] == 0).all()


def test_overlapping_muscles_share_and_leave_nothing_passive(flesh):
    muscle = box([0, 0, 0], [60, 30, 30])
    weights = initial_weights(*flesh, [muscle, muscle]).toarray()
    assert np.allclose(weights, [0, 0.5, 0.5])


def test_volume_of_a_surface_with_a_gap_or_a_turned_face():
    """The sum over triangles would depend on where the origin is."""
    whole = tilted(box([10, 10, 10], [30, 16, 14]))
    ball = trimesh.creation.icosphere(3, radius=9)
    holed = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)[6:])
    turned = Surface(ball.vertices, np.vstack([ball.faces[:6, ::-1], ball.faces[6:]]))
    assert enclosed_volume(whole) == pytest.approx(20 * 6 * 4)
    for surface in (holed, turned):
        assert enclosed_volume(surface) == pytest.approx(ball.volume, rel=0.03)


def test_surface_turned_inside_out_counts_the_same(flesh):
    muscle = tilted(box([3, 4, 5], [20, 25, 20]))
    turned = Surface(muscle.vertices, muscle.faces[:, ::-1])
    assert np.allclose(
        initial_weights(*flesh, [muscle]).toarray(), initial_weights(*flesh, [turned]).toarray()
    )
