"""Terms of the objective: derivatives against differences."""

import numpy as np
import pytest

from solver.fitting.face import Face
from solver.fitting.objective import SkinDistance, SumTerm, Target
from tests.solver.block import block_model


@pytest.fixture(scope="module")
def face():
    return Face(block_model())


def scans(face):
    """A target by points and one by planes, both well away from the face."""
    rng = np.random.default_rng(5)
    points = face.face_points(face.model.rest) + rng.standard_normal((len(face.model.face), 3))
    normals = rng.standard_normal(points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weights = rng.uniform(0.0, 1.0, len(points))
    return Target.from_points(points, weights), Target.from_points(points, weights, normals)


@pytest.mark.parametrize("kind", ["points", "planes", "together"])
def test_gradient_and_curvature_match_differences(face, kind):
    points, planes = (SkinDistance(face, target) for target in scans(face))
    term = {"points": points, "planes": planes, "together": SumTerm((points, planes))}[kind]
    rng = np.random.default_rng(6)
    x = face.model.rest + 0.2 * rng.standard_normal(face.model.rest.shape)
    step = rng.standard_normal(x.shape)
    slope = (term.value(x + 1e-5 * step) - term.value(x - 1e-5 * step)) / 2e-5
    change = (term.gradient(x + 1e-5 * step) - term.gradient(x - 1e-5 * step)) / 2e-5
    assert abs(slope) > 1e-3
    assert np.sum(term.gradient(x) * step) == pytest.approx(slope, rel=1e-7)
    assert np.abs(change).max() > 1e-3
    exact = (term.curvature(x) @ step.ravel()).reshape(x.shape)
    np.testing.assert_allclose(exact, change, atol=1e-7 * np.abs(change).max())


def test_a_plane_lets_the_skin_slide(face):
    points = face.face_points(face.model.rest)
    along_z = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    moved = Target.from_points(points + np.array([1.0, 2.0, 0.0]), normals=along_z)
    assert moved.value(points) == 0.0
    assert moved.distances(points).max() == 0.0
