"""What each edit makes of a block of flesh, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from solver.edits import DENSITY, apply
from solver.edits.changes import (
    Bone,
    Fat,
    Filler,
    Paralysis,
    Scaling,
    into_volume,
    spots,
    under_skin,
)
from solver.errors import InputError
from solver.fitting.face import Face
from solver.mechanics.flesh import shape_gradients
from solver.surface import Surface, distance_to_path
from tests.solver.block import block_model, divided_block, head_block


@pytest.fixture(scope="module")
def model():
    """A block of 150 x 120 x 45 mm before a plate of bone on its back, with a tooth on it."""
    block = head_block()
    corners = np.array([[0.0, 0, 0], [150, 0, 0], [150, 120, 0], [0, 120, 0]])
    plate = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    tooth = np.array([[75.0, 20.0, 2.0], [75.0, 100.0, 2.0]])
    skin = Surface(np.vstack([block.skin.vertices, tooth]), block.skin.faces)
    return replace(
        block,
        skin=skin,
        bones={"mandible": plate, "cranium": plate},
        attached_mandible=np.array([len(skin.vertices) - 2]),
    )


def centres(model):
    return model.rest[model.tets].mean(axis=1)


def passive(S):
    return S[:, [0]].toarray()[:, 0]


def test_nothing_is_edited_without_edits(model):
    edited = apply([], model, model.weights)
    assert edited.model is model
    assert (edited.growth == 1).all()
    assert (edited.stiffness_factor == 1).all()
    assert (edited.density == DENSITY).all()
    assert (edited.bones == 0).all()
    assert (model.weights != edited.S).nnz == 0


def test_fat_grows_by_the_passive_share(model):
    edited = apply([Fat(0.9, 1.2)], model, model.weights)
    share = passive(model.weights)
    assert share.min() < 0.5 < share.max()
    np.testing.assert_allclose(edited.growth, 0.9 * (1 - share) + 1.2 * share)
    fat = edited.growth > 1
    np.testing.assert_allclose(edited.stiffness_factor[fat], edited.growth[fat] ** -3)
    assert (edited.stiffness_factor[~fat] == 1).all()
    assert fat.any()
    assert (~fat).any()


def test_edits_add_up_in_their_order(model):
    both = apply(
        [Fat(1.0, 1.2), Scaling("stiffness_factor", 4.0), Fat(1.0, 1.1)], model, model.weights
    )
    one = apply([Fat(1.0, 1.2)], model, model.weights)
    other = apply([Fat(1.0, 1.1)], model, model.weights)
    np.testing.assert_allclose(both.growth, one.growth * other.growth)
    np.testing.assert_allclose(
        both.stiffness_factor, 4 * one.stiffness_factor * other.stiffness_factor
    )


def test_edits_that_add_up_to_too_much_are_refused(model):
    for fat in (Fat(1.4, 1.4), Fat(0.6, 0.6)):
        once = apply([fat], model, model.weights)
        assert np.abs(np.log(once.growth)).max() > 0.3
        with pytest.raises(InputError, match="together") as raised:
            apply([fat, fat], model, model.weights)
        assert raised.value.code == "scene.growth"


def test_a_paralysed_muscle_is_passive_flesh(model):
    before = model.weights.copy()
    edited = apply([Paralysis(("left",), strength=0.25)], model, before)
    np.testing.assert_allclose(edited.S[:, [1]].toarray(), 0.25 * before[:, [1]].toarray())
    np.testing.assert_allclose(edited.S[:, [2]].toarray(), before[:, [2]].toarray())
    np.testing.assert_allclose(edited.S.sum(axis=1), 1.0)
    np.testing.assert_array_equal(edited.S.indices, before.indices)
    np.testing.assert_array_equal(before.data, model.weights.data)  # not changed in place


def test_a_whole_muscle_is_paralysed_in_all_its_compartments():
    whole = block_model()
    divided = divided_block()
    both = [Paralysis(("left",), strength=0.25), Paralysis(("right",), side="left")]
    expected = apply(both, whole, whole.weights).S
    found = apply(both, divided, divided.weights).S
    np.testing.assert_array_equal(found.data, expected.data)
    upper = apply([Paralysis(("left.upper",))], divided, divided.weights).S
    assert upper[:, [2]].sum() == 0.0
    np.testing.assert_array_equal(upper[:, [1]].data, divided.weights[:, [1]].data)


def test_a_paralysed_side_ends_at_the_middle(model):
    edited = apply([Paralysis(side="left")], model, model.weights)
    x = centres(model)[:, 0] - model.jaw.origin[0]
    assert (passive(edited.S)[x > 5.0] == 1).all()
    untouched = x < -5.0
    np.testing.assert_array_equal(passive(edited.S)[untouched], passive(model.weights)[untouched])
    np.testing.assert_allclose(edited.S.sum(axis=1), 1.0)


def test_stiffness_and_density_follow_a_map(model):
    painted = spots(model, np.array([[75.0, 60.0, 45.0]]), 40.0)
    edited = apply(
        [Scaling("stiffness_factor", 4.0, painted), Scaling("density", 0.5, painted)],
        model,
        model.weights,
    )
    near = np.linalg.norm(centres(model) - [75.0, 60.0, 45.0], axis=1)
    assert (
        edited.stiffness_factor[np.argmin(near)]
        > 1.5
        > 1.2
        > edited.stiffness_factor[np.argmax(near)]
    )
    np.testing.assert_allclose(
        np.log(edited.stiffness_factor) / np.log(4.0),
        np.log(edited.density / DENSITY) / np.log(0.5),
    )


def test_a_map_runs_into_the_flesh(model):
    everywhere = into_volume(model, np.ones(len(model.skin.vertices)))
    np.testing.assert_allclose(everywhere, 1.0, atol=1e-3)
    vertices = np.arange(len(model.skin.vertices))
    half = into_volume(model, np.isin(vertices, model.regions["left"]).astype(float))
    x = centres(model)[:, 0]
    assert half[x > 120].min() > 0.8
    assert half[x < 30].max() < 0.2
    steps = [half[np.abs(x - at) < 15].mean() for at in (15, 45, 75, 105, 135)]
    assert (np.diff(steps) > 0).all()


def test_a_map_reaches_as_deep_as_it_is_told(model):
    whole = np.ones(len(model.skin.vertices))
    shallow = into_volume(model, whole, depth_mm=10.0)
    front = centres(model)[:, 2]
    outer, inner = (shallow[front == each].mean() for each in (front.max(), front.min()))
    assert 1.0 >= outer > 2.0 * inner > 0.0
    assert (into_volume(model, whole) - shallow).min() > -1e-9


def test_what_is_fat_does_not_go_by_a_fitted_S(model):
    weakened = apply([Paralysis()], model, model.weights).S
    assert not np.allclose(passive(weakened), passive(model.weights))
    fitted, own = (apply([Fat(0.9, 1.2)], model, S).growth for S in (weakened, model.weights))
    np.testing.assert_array_equal(fitted, own)


def test_filler_takes_the_volume_it_was_given(model):
    path = np.array([[50.0, 60.0, 35.0], [100.0, 60.0, 35.0]])
    edited = apply([Filler(path, 2.0, radius_mm=15.0)], model, model.weights)
    volumes = shape_gradients(model.rest, model.tets)[1]
    np.testing.assert_allclose(volumes @ (edited.growth**3 - 1), 2000.0)
    away = distance_to_path(centres(model), path)
    assert edited.growth[np.argmin(away)] > 1.005 > 1.0001 > edited.growth[np.argmax(away)]


def test_filler_takes_its_volume_in_flesh_that_has_grown(model):
    path = np.array([[50.0, 60.0, 35.0], [100.0, 60.0, 35.0]])
    fat = apply([Fat(1.2, 1.2)], model, model.weights)
    both = apply([Fat(1.2, 1.2), Filler(path, 2.0, radius_mm=15.0)], model, model.weights)
    volumes = shape_gradients(model.rest, model.tets)[1]
    np.testing.assert_allclose(volumes @ (both.growth**3 - fat.growth**3), 2000.0)


def test_the_distance_to_a_path_has_its_ends_and_corners():
    path = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])
    points = np.array([[-3.0, 4, 0], [5, 0, 2], [12, 5, 0], [13, 14, 0], [10, 0, 0]])
    np.testing.assert_allclose(distance_to_path(points, path), [5, 2, 2, 5, 0], atol=1e-12)
    np.testing.assert_allclose(distance_to_path(points, path[:1]), [5, 29**0.5, 13, 365**0.5, 10])


def test_a_needle_goes_under_the_skin(model):
    point = under_skin(model, np.array([[75.0, 60.0, 45.0]]), np.array([3.0]))
    np.testing.assert_allclose(point, [[75.0, 60.0, 42.0]])


def test_fat_fades_where_the_flesh_is_cut_off(model):
    cut = replace(model, cut=np.flatnonzero(model.rest[:, 1] == 0.0))
    edited = apply([Fat(1.2, 1.2)], cut, cut.weights)
    y = centres(cut)[:, 1]
    np.testing.assert_allclose(edited.growth[y > 25.0], 1.2)
    assert edited.growth[y < 7.0].max() < 1.15


def partly_on_flesh(model):
    """Return the model with skin that follows the flesh only where x is below 130 mm."""
    kept = np.flatnonzero(model.skin.vertices[model.embedded, 0] < 130.0)
    return replace(
        model,
        embedded=model.embedded[kept],
        embedding=model.embedding[kept],
        offset=model.offset[kept],
        face=model.embedded[kept],
    )


def test_fat_fades_along_the_border_of_what_follows_the_flesh(model):
    shown = partly_on_flesh(model)
    edited = apply([Fat(1.2, 1.2)], shown, shown.weights)
    front = centres(shown)[:, 2] > 30.0
    x = centres(shown)[:, 0]
    np.testing.assert_allclose(edited.growth[x < 85.0], 1.2)
    assert edited.growth[front & (x > 120.0)].min() < 1.15


def test_a_chin_moves_with_its_teeth_and_nothing_else(model):
    forward = np.array([0.0, 0.0, 5.0])
    edit = Bone("mandible", np.array([75.0, 20.0, 10.0]), 30.0, forward)
    edited = apply([edit], model, model.weights)
    moved = np.flatnonzero(np.abs(edited.bones).max(axis=1))
    assert len(moved)
    assert np.isin(moved, model.mandible).all()
    share = (1 - (np.linalg.norm(model.rest[moved] - [75, 20, 0], axis=1) / 30) ** 2) ** 2
    np.testing.assert_allclose(edited.bones[moved], share[:, None] * forward)
    tooth = edited.model.skin.vertices - model.skin.vertices
    lower = model.attached_mandible[0]
    np.testing.assert_allclose(tooth[lower, 2], 5 * (1 - (2 / 30) ** 2) ** 2)
    assert np.count_nonzero(tooth) == 1
    np.testing.assert_array_equal(edited.model.rest, model.rest)


def test_eyeballs_stay_round_where_the_bone_beside_them_moves(model):
    tooth = len(model.skin.vertices) - 1
    points = np.vstack([model.skin.vertices, model.skin.vertices[tooth] + [5.0, 0.0, 0.0]])
    regions = {**model.regions, "left_eyeball": np.array([tooth + 1])}
    seen = replace(model, skin=model.skin.with_vertices(points), regions=regions)
    edit = Bone("cranium", points[tooth], 60.0, np.array([0.0, 0.0, 5.0]))
    moved = apply([edit], seen, seen.weights).model.skin.vertices - points
    assert moved[tooth, 2] > 4.0
    assert np.count_nonzero(moved) == 1


def test_skin_beyond_the_flesh_is_left_to_follow_it(model):
    """It would move twice: with the bone, and with the flesh on the bone."""
    shown = partly_on_flesh(model)
    beyond = np.setdiff1d(model.embedded, shown.embedded)
    edit = Bone("cranium", np.array([150.0, 90.0, 0.0]), 80.0, np.array([5.0, 0.0, 0.0]))
    edited = apply([edit], shown, shown.weights)
    assert len(beyond)
    assert np.abs(edited.bones).max() > 3.0
    assert not (edited.model.skin.vertices - shown.skin.vertices)[beyond].any()


def test_a_moved_cranium_takes_its_own_teeth_and_sliding_flesh(model):
    sliding = model.cranium[:5]
    loose = replace(model, cranium=model.cranium[5:], sliding=sliding)
    edit = Bone("cranium", loose.rest[sliding[0]], 60.0, np.array([3.0, 0.0, 0.0]))
    edited = apply([edit], loose, loose.weights)
    np.testing.assert_allclose(edited.bones[sliding[0]], [3.0, 0, 0])
    assert (edited.bones[loose.mandible] == 0).all()


def test_stiffer_flesh_is_held_to_its_bone_as_firmly(model):
    loose = replace(model, cranium=model.cranium[5:], sliding=model.cranium[:5])
    edited = apply([Scaling("stiffness_factor", 20.0)], loose, loose.weights)
    held = [
        Face(loose, stiffness_factor=each).flesh.sliding for each in (None, edited.stiffness_factor)
    ]
    assert held[0].stiffness.min() > 0.0
    np.testing.assert_allclose(held[1].stiffness, 20.0 * held[0].stiffness)


@pytest.mark.parametrize(
    ("edit", "code", "words"),
    [
        (Fat(1.0, 3.0), "scene.fat", "3.0"),
        (Fat(np.nan, 1.0), "scene.fat", "nan"),
        (Fat(1.0, 1.2, np.ones(7)), "scene.map", "shape (7,)"),
        (Fat(1.0, 1.2, np.full(65, 2.0)), "scene.map", "first is 2.0 at vertex 0"),
        (Fat(1.0, 1.2, np.full(65, np.nan)), "scene.map", "nan"),
        (Scaling("stiffness_factor", 0.0), "scene.factor", "0.0"),
        (Scaling("density", 1e4), "scene.factor", "10000"),
        (Paralysis(("tongue",)), "scene.muscle", "tongue"),
        (Paralysis(strength=1.5), "scene.strength", "1.5"),
        (Filler(np.array([[75.0, 60, 35]]), 50.0), "scene.filler", "at most"),
        (Filler(np.zeros((0, 3)), 1.0), "scene.filler", "path"),
        (Filler(np.array([[75.0, 60, 200]]), 1.0), "scene.filler", "no flesh"),
        (Filler(np.array([[75.0, 60, 45]]), 1.0, radius_mm=1e-3), "scene.filler", "no flesh"),
        (Bone("mandible", np.array([75.0, 20, 0]), 5.0, np.array([0, 0, 9.0])), "scene.bone", "13"),
        (Bone("mandible", np.array([75.0, 20, 90]), 30.0, np.ones(3)), "scene.bone", "90 mm off"),
    ],
)
def test_what_can_not_be_is_refused(model, edit, code, words):
    if code == "scene.map" and len(edit.painted) == 65:
        assert len(model.skin.vertices) == 65
    with pytest.raises(InputError, match=words.replace("(", r"\(").replace(")", r"\)")) as raised:
        apply([edit], model, model.weights)
    assert raised.value.code == code
