"""Compartments of muscles: those of both anatomies, and cuts of which the result is known."""

import numpy as np
import pytest

from solver.anatomy.build import divide_muscles, number_compartments
from solver.anatomy.meshing import find_or_make_mesh
from solver.anatomy.muscle_weights import fibre_directions, muscle_volumes
from solver.anatomy.template import Compartments, Muscle
from solver.drawing.head import both_sides
from solver.surface import Surface
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_template import build_ict_template
from tests.fixtures import data_folder
from tests.solver.block import dense_pattern, divided_block, grid

LEAST_MUSCLES = 90
MOST_APART = 0.1  # of the volumes of left and right
MOST_APART_MM = 8.0  # of a compartment's centre and the mirrored one's: an edge of a tet


@pytest.fixture(
    scope="module", params=["builtin", pytest.param("bodyparts3d", marks=pytest.mark.slow)]
)
def template(request):
    if request.param == "builtin":
        return builtin_template()
    folders = data_folder("bodyparts3d"), data_folder("ict_facekit")
    return find_or_make_mesh(build_ict_template(*folders))


@pytest.fixture(scope="module")
def divided(template):
    mesh = template.mesh
    shape = mesh.vertices, mesh.tets, mesh.weights
    fibres = fibre_directions(*shape, template.muscles)
    middle = float(template.condyles[:, 0].mean())
    numbers = number_compartments(*shape, fibres, template.muscles, middle)
    return divide_muscles(mesh.weights, template.muscles, numbers)


def test_compartments_are_the_whole_muscles(template, divided):
    assert len(divided.names) == len(set(divided.names)) >= LEAST_MUSCLES
    wholes = [muscle.name for muscle in template.muscles]
    assert list(dict.fromkeys(divided.wholes)) == wholes
    before = template.mesh.weights.tocsc()
    after = divided.weights.tocsc()
    assert divided.weights.has_canonical_format
    for column, name in enumerate(wholes, start=1):
        parts = [k for k, whole in enumerate(divided.wholes, start=1) if whole == name]
        assert abs(after[:, parts].sum(axis=1) - before[:, [column]].toarray().ravel()).max() == 0
        # none shares a tet with another, as one muscle has one entry in a tet
        assert sum(after[:, [k]].nnz for k in parts) == before[:, [column]].nnz


def test_left_and_right_have_the_same_compartments(template, divided):
    mesh = template.mesh
    names = divided.names
    sizes = muscle_volumes(mesh.vertices, mesh.tets, divided.weights)
    shares = divided.weights[:, 1:].tocsc() / divided.weights[:, 1:].sum(axis=0)
    centres = shares.T @ mesh.vertices[mesh.tets].mean(axis=1)
    assert sizes.min() > 0.0
    kinds = [both_sides(name) for name in names]
    pairs = {kind: [k for k, each in enumerate(kinds) if each == kind] for kind in kinds}
    pairs = [pair for pair in pairs.values() if len(pair) == 2]
    assert len(pairs) > 40
    for one, other in pairs:
        assert abs(np.log(sizes[one] / sizes[other])) < MOST_APART, names[one]
        mirrored = centres[one] * [-1.0, 1.0, 1.0]
        assert np.linalg.norm(mirrored - centres[other]) < MOST_APART_MM, names[one]


@pytest.mark.parametrize(
    ("ring", "inner", "outer"),
    [("orbicularis oris", "marginal", "peripheral"), ("palpebral", "pretarsal", "preseptal")],
)
def test_rings_have_an_inner_and_an_outer_part(template, divided, ring, inner, outer):
    """The outer one lies further up or down from the slit of the mouth or the lids."""
    mesh = template.mesh
    inside = divided.weights.toarray()[:, 1:]
    heights = mesh.vertices[mesh.tets].mean(axis=1)[:, 1]
    mine = [ring in both_sides(whole) for whole in divided.wholes]
    names = [name for name, own in zip(divided.names, mine, strict=True) if own]
    pairs = [(name, name.replace(inner, outer)) for name in names if name.endswith(inner)]
    assert len(names) == 2 * len(pairs) == 16
    flesh = inside[:, mine].sum(axis=1)
    slit = flesh @ heights / flesh.sum()
    for pair in pairs:
        parts = [inside[:, divided.names.index(name)] for name in pair]
        near, far = (abs(part @ heights / part.sum() - slit) for part in parts)
        assert far > near + 0.2, pair


def test_strips_lie_side_by_side_and_sectors_behind_each_other():
    model = divided_block((12, 8, 2))
    assert model.muscle_names == ("left.lower", "left.upper", "right.lower", "right.upper")
    assert model.muscle_groups == ("left", "left", "right", "right")
    centres = model.rest[model.tets].mean(axis=1)
    heights = [centres[model.weights[:, [k]].toarray().ravel() > 0.0, 1] for k in (1, 2)]
    assert heights[0].max() < heights[1].min() + 6.0
    x, y = np.eye(3)[:2]
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), int))
    parts = Compartments("sectors", ("first", "last"))
    numbers = number_of(Muscle("band", nothing, -x, 50 * x, 0 * x, compartments=parts), model)
    assert centres[numbers == 0, 0].min() > centres[numbers == 1, 0].max() - 5.0
    assert np.abs(numbers.mean() - 0.5) < 0.1
    assert (number_of(Muscle("whole", nothing, y, x, y), model) == 0).all()


def test_parts_that_are_cut_again_have_both_names():
    parts = Compartments.read("sectors | outward", "upper; lower | inner; outer")
    muscle = Muscle("ring", None, None, None, None, compartments=parts)
    assert muscle.compartment_names == (
        "ring.upper.inner",
        "ring.upper.outer",
        "ring.lower.inner",
        "ring.lower.outer",
    )
    assert Compartments.read(*parts.cells) == parts


@pytest.mark.parametrize(("side", "corner"), [(1.0, "left"), (-1.0, "right")])
def test_a_ring_begins_at_its_top_and_goes_outwards(side, corner):
    vertices, tets = grid((16, 16, 1), (80.0, 80.0, 4.0))
    vertices = vertices - [40.0, 40.0, 0.0] + [side * 60.0, 0.0, 0.0]
    from_middle = vertices[tets].mean(axis=1) - [side * 60.0, 0.0, 0.0]
    radius = np.linalg.norm(from_middle[:, :2], axis=1)
    inside = (radius > 15.0) & (radius < 38.0)
    weights = dense_pattern(np.stack([1.0 - inside, 1.0 * inside], axis=1))
    names = ("upper outer", "lower outer", "lower inner", "upper inner")
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), int))
    z = np.eye(3)[2]
    ring = Muscle(corner, nothing, z, z, z, True, Compartments("sectors", names))
    fibres = np.zeros((weights.nnz, 3))
    numbers = number_compartments(vertices, tets, weights, fibres, (ring,), 0.0)
    found = numbers[weights.indices == 1][inside]
    outward = side * from_middle[inside, 0]
    height = from_middle[inside, 1]
    for number, signs in enumerate([(1, 1), (1, -1), (-1, -1), (-1, 1)]):
        own = found == number
        assert np.mean(signs[0] * outward[own] > -3.0) > 0.95
        assert np.mean(signs[1] * height[own] > -3.0) > 0.95


def number_of(muscle, model):
    """The compartment of every tet of a block, in which one muscle is everywhere."""
    weights = dense_pattern(np.tile([0.5, 0.5], (len(model.tets), 1)))
    fibres = np.tile(muscle.fibre, (weights.nnz, 1))
    numbers = number_compartments(model.rest, model.tets, weights, fibres, (muscle,), 25.0)
    return numbers[weights.indices == 1]


@pytest.mark.parametrize(
    ("cut", "names", "match"),
    [
        ("upwards", "a; b", "cut is none of sectors, lateral"),
        ("sectors", "a", "at least two"),
        ("sectors", "a; a", "no different names"),
        ("", "a; b", "cut is none of"),
        ("lateral", "a.1; b", "has a dot"),
        ("sectors | outward", "a; b", "2 cuts, and names of 1"),
        ("sectors | upwards", "a; b | c; d", "cut is none of"),
    ],
)
def test_a_table_that_is_wrong_is_told(cut, names, match):
    assert Compartments.read("", "") is None
    with pytest.raises(ValueError, match=match):
        Compartments.read(cut, names)
