"""A researcher's slip in S, a pose or a term is told by name, before anything is solved."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver import Face, Material, PassiveTerm, Pose, Target, check_term, expression_terms
from solver.errors import InputError, SolveError
from tests.solver.block import block_model, poses

MODEL = block_model()
S = MODEL.weights


def changed(row, column, value):
    found = S.toarray()
    found[row, column] = value
    return sp.csr_array(found)


# column 0 and muscles only where they are: rows in another order have other places
SPARSE = sp.csr_array(S.toarray())
ORDERED = replace(MODEL, weights=SPARSE)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (S.toarray(), "S is ndarray, not a sparse matrix"),
        (S[:100], r"shape \(100, 3\), not \(360, 3\): a row for each tet"),
        (S[:, :2], r"shape \(360, 2\), not \(360, 3\).* 2 muscles"),
        (changed(7, 1, np.nan), r"not finite in row 7, column 1 \(left\)"),
        (changed(7, 2, np.inf), r"not finite in row 7, column 2 \(right\)"),
        (changed(9, 1, -0.3), r"negative in row 9, column 1 \(left\): -0.3"),
        (changed(11, 0, 7.0), "row 11 of S sums to 7"),
        (SPARSE[::-1], r"row \d+ of S has a share of (left|right), .* another order"),
    ],
)
def test_a_wrong_geometry_is_told(wrong, words):
    for make in (lambda: Face(ORDERED, wrong), lambda: Face(ORDERED).with_weights(wrong)):
        with pytest.raises(InputError, match=words) as caught:
            make()
        assert caught.value.code == "face.weights"


def test_a_geometry_of_fewer_muscles_is_none_that_is_wrong():
    cut = S.toarray()
    cut[:, 0] += cut[:, 2]
    cut[:, 2] = 0.0
    assert Face(MODEL, sp.csr_array(cut)).S.nnz < S.nnz


def of(a=None, b=None):
    pose = poses(1)[0]
    a = pose.a if a is None else a(pose.a.copy())
    b = pose.b if b is None else b(pose.b.copy())
    return Pose(a, b)


def put(place, value):
    def change(array):
        array[place] = value
        return array

    return change


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (of(put((1, 2), np.nan)), "activation of right is not finite"),
        (of(b=put(0, np.inf)), "jaw is not finite"),
        (of(lambda a: a[:1]), r"activations is \(1, 6\), not \(2, 6\)"),
        (of(b=lambda b: b[:3]), r"jaw is \(3,\), not \(5,\)"),
        (of(b=put(0, 12.0)), "turns by 12 .* radians"),
    ],
)
def test_a_wrong_pose_is_told(pose, words):
    face = Face(MODEL)
    for ask in (
        lambda: face.continuation(face.rest, pose),
        lambda: face.solve_equilibrium(pose, MODEL.rest),
    ):
        with pytest.raises(InputError, match=words) as caught:
            ask()
        assert caught.value.code == "face.pose"


class SkinPoints(PassiveTerm):
    """E = sum_e k / 2 |sum_u w_u x_u - place_e|^2, each point within a tet."""

    k = 3.0

    def __init__(self, vertices, weights, places):
        self.vertices = vertices
        self.weights = weights
        self.places = places

    def off(self, x):
        return np.einsum("eu,eui->ei", self.weights, x[self.vertices]) - self.places

    def energy(self, x, controls):
        return 0.5 * self.k * float((self.off(x) ** 2).sum())

    def forces(self, x, controls):
        return self.k * self.weights[:, :, None] * self.off(x)[:, None]

    def stiffness_of(self, some):
        u, v = np.triu_indices(4)
        weights = self.weights[some]
        return self.k * (weights[:, u] * weights[:, v])[..., None, None] * np.eye(3)


def points(term=SkinPoints, **changes):
    given = {
        "vertices": MODEL.tets[:3],
        "weights": np.array([[0.1, 0.2, 0.3, 0.4]] * 3),
        "places": np.full((3, 3), 2.0),
    }
    return term(**{**given, **changes})


class Halved(SkinPoints):
    def forces(self, x, controls):
        return 0.5 * super().forces(x, controls)


class Unordered(SkinPoints):
    def stiffness_of(self, some):
        return super().stiffness_of(some)[:, ::-1]


class Diagonal(SkinPoints):
    def stiffness_of(self, some):
        return super().stiffness_of(some)[:, :4]


def test_a_term_within_tets_passes_and_pulls():
    term = points()
    check_term(term, MODEL.rest)
    assert Face(MODEL, energy=[term]).rest.equilibrium.residual < 1e-6


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (Halved, "forces of Halved are not its energy's gradient"),
        (Unordered, "blocks of Unordered .* entry 0"),
        (Diagonal, r"blocks of Diagonal have the shape \(3, 4, 3, 3\), not \(3, 10, 3, 3\)"),
    ],
)
def test_a_term_that_contradicts_itself_is_told(term, words):
    with pytest.raises(InputError, match=words):
        check_term(points(term), MODEL.rest)


@pytest.mark.parametrize(
    ("term", "words"),
    [
        (3, "int is no term of the energy: it has no vertices, energy"),
        (points(vertices=MODEL.tets[0]), r"int64 of shape \(4,\), not whole numbers \(e, 1\)"),
        (points(vertices=np.tile([0, 1, 2, 60], (3, 1))), r"vertices \[0, 1, 2, 60\] .* no tet's"),
        (points(vertices=MODEL.tets[:3] + 1000), "entry 0 of SkinPoints has vertices"),
    ],
)
def test_a_face_refuses_what_is_no_term(term, words):
    with pytest.raises(InputError, match=words) as caught:
        Face(MODEL, energy=[term])
    assert caught.value.code == "face.energy"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_term_that_is_not_finite_is_named(value):
    face = Face(MODEL, energy=[points(places=np.full((3, 3), value))])
    with pytest.raises(SolveError, match="energy of SkinPoints is not finite"):
        _ = face.rest


def test_an_unknown_name_is_told_with_those_there_are():
    with pytest.raises(InputError, match="no muscle 'middle'; it has left, right") as caught:
        MODEL.muscle_number("middle")
    assert caught.value.code == "model.muscle"
    assert MODEL.muscle_number("right") == 1
    with pytest.raises(InputError, match="no law 'hencky'; there are corotated, neo_hookean"):
        Face(MODEL, material=Material(law="hencky"))


def test_a_target_of_another_count_is_told():
    front = MODEL.skin.vertices
    for wrong, words in (
        (
            lambda: Target.from_points(front[:, :2]),
            r"points have the shape \(30, 2\), not \(k, 3\)",
        ),
        (lambda: Target.from_points(front, np.ones(7)), r"weights have the shape \(7,\), not"),
        (lambda: Target.from_points(front, normals=front[:5]), r"normals have the shape \(5, 3\)"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            wrong()
        assert caught.value.code == "target.shape"
    target = Target.from_points(front[:-3])
    with pytest.raises(InputError, match="has 27 points, the face 30"):
        expression_terms(Face(MODEL), {"smile": target})
