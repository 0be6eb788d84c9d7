"""Tracks of a block: shapes without their jaw, exact sums, targets and their derivatives, files."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.template import ShapeBasis
from solver.errors import InputError
from solver.mechanics.boundary import move_jaw
from solver.tracks.basis import MuscleTracks, TrackOptions, TrackTargets
from solver.tracks.shapes import template_shapes
from tests.solver.tracks.block import OPEN, block_shapes, tracked_block


@pytest.fixture(scope="module")
def model():
    return tracked_block()


@pytest.fixture(scope="module")
def shapes(model):
    return block_shapes(model)


@pytest.fixture(scope="module")
def tracks(model, shapes):
    return MuscleTracks.of(model, shapes)


def test_the_jaw_of_a_shape_is_that_of_its_lower_teeth(tracks):
    assert tracks.names == ("aside", "bulge", "open")
    assert np.allclose(tracks.jaw, [np.zeros(5), np.zeros(5), OPEN], atol=1e-8)
    assert tracks.teeth_mm.max() < 1e-8
    assert tracks.notices == ()


@pytest.mark.parametrize("bones", ["free", "held"])
def test_a_target_at_weight_one_has_the_skin_of_its_shape(model, shapes, bones):
    tracks = MuscleTracks.of(model, shapes, TrackOptions(bones=bones))
    targets = TrackTargets(model, tracks)
    for name, motion in shapes.items():
        pose = targets.at(tracks.controls({name: 1.0}))
        skin = model.embedding @ pose.target + model.offset
        expected = (model.skin.vertices + motion)[model.embedded]
        # one tet's vertices carry several points of the skin
        assert np.linalg.norm(skin - expected, axis=1).mean() < 0.02
        bone = move_jaw(model.jaw, model.rest[model.mandible], pose.jaw)
        if bones == "held":
            assert np.allclose(pose.target[model.mandible], bone)


def test_the_morph_of_a_sum_is_the_sum_of_the_morphs(model, shapes):
    added = {"both": 0.7 * shapes["aside"] + 0.4 * shapes["bulge"]}
    tracks = MuscleTracks.of(model, shapes | added)
    sum_of = 0.7 * tracks.morphs[0] + 0.4 * tracks.morphs[1]
    size = np.abs(tracks.morphs[3]).max()
    assert size > 0.5
    assert np.abs(tracks.morphs[3] - sum_of).max() <= 1e-9 * size


def test_a_corrective_is_exact_together_with_what_it_corrects(model, shapes):
    named = {"jawOpen": shapes["open"], "mouthClose": shapes["bulge"]}
    tracks = MuscleTracks.of(model, named)
    pose = TrackTargets(model, tracks).at(tracks.controls({"jawOpen": 1.0, "mouthClose": 1.0}))
    skin = model.embedding @ pose.target + model.offset
    expected = (model.skin.vertices + shapes["open"] + shapes["bulge"])[model.embedded]
    assert np.linalg.norm(skin - expected, axis=1).mean() < 0.02
    assert np.allclose(pose.jaw, OPEN, atol=1e-8)


def test_nothing_is_asked_for_at_rest(model, tracks):
    pose = TrackTargets(model, tracks).at(np.zeros(tracks.size))
    assert np.allclose(pose.target, model.rest, atol=1e-12)
    assert np.allclose(pose.activations, [1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
    assert (pose.lengths > 10.0).all()


def test_a_muscle_is_activated_by_the_length_of_its_line(model, tracks):
    targets = TrackTargets(model, tracks)
    rest = targets.at(np.zeros(8))
    pose = targets.at(tracks.controls({"aside": 1.0}))
    stretch = pose.lengths / rest.lengths
    assert stretch[0] > 1.01
    assert stretch[1] < 0.99
    # parallel fibres along x: the activation's first number is their stretch
    assert np.allclose(pose.activations[:, 0], stretch)
    assert np.allclose(np.prod(pose.activations[:, [0, 3, 5]], axis=1), 1.0)


def test_rates_are_the_derivatives_of_targets(model, tracks):
    targets = TrackTargets(model, tracks)
    h = 1e-5
    q = np.array([0.6, 0.4, 0.7, 0.05, 0.02, 0.5, -0.3, 0.2])
    rates = targets.rates(q)
    for number in range(len(q)):
        step = h * np.eye(len(q))[number]
        ahead = targets.at(q + step)
        behind = targets.at(q - step)
        for what in ("target", "jaw", "activations"):
            expected = (getattr(ahead, what) - getattr(behind, what)) / (2.0 * h)
            found = getattr(rates, what)[..., number]
            assert np.abs(found - expected).max() <= 1e-7 * max(np.abs(expected).max(), 1.0), what
        assert np.abs(rates.target[..., number]).max() > 0.01
    assert np.abs(rates.activations).max() > 0.01


def test_tracks_come_back_from_their_file(tmp_path, model, tracks):
    file = tmp_path / "tracks.npz"
    tracks.save(file)
    again = MuscleTracks.load(file, model)
    q = np.array([0.6, 0.4, 0.7, 0.05, 0.02, 0.5, -0.3, 0.2])
    found, expected = (TrackTargets(model, each).at(q) for each in (again, tracks))
    assert np.array_equal(found.target, expected.target)
    assert np.array_equal(found.activations, expected.activations)
    assert (again.shares(model) != tracks.shares(model)).nnz == 0
    for what in ("names", "bones", "length_mm", "law", "firmness", "notices", "model_sha256"):
        assert getattr(again, what) == getattr(tracks, what)
    assert np.array_equal(again.stiffness, tracks.stiffness)


def test_tracks_of_another_model_are_refused(tmp_path, tracks):
    file = tmp_path / "tracks.npz"
    tracks.save(file)
    with pytest.raises(InputError) as error:
        MuscleTracks.load(file, tracked_block((4, 4, 3)))
    assert error.value.code == "tracks.model"
    file.write_bytes(b"nothing")
    with pytest.raises(InputError) as error:
        MuscleTracks.load(file, tracked_block())
    assert error.value.code == "tracks.unreadable"


def test_an_unknown_shape_is_told_with_the_nearest(tracks):
    with pytest.raises(InputError, match="did you mean bulge") as error:
        tracks.controls({"bulg": 1.0})
    assert error.value.code == "tracks.name"


def test_shapes_that_cannot_be_carried_are_refused(model, shapes):
    broken = shapes["aside"].copy()
    broken[7, 1] = np.nan
    with pytest.raises(InputError, match=r"bad .*first 7") as error:
        MuscleTracks.of(model, {"bad": broken})
    assert error.value.code == "tracks.shape"
    with pytest.raises(InputError) as error:
        MuscleTracks.of(model, {"short": shapes["aside"][:-1]})
    assert error.value.code == "tracks.topology"


def test_no_shapes_make_no_tracks(model):
    with pytest.raises(InputError) as error:
        MuscleTracks.of(model, {})
    assert error.value.code == "tracks.no_shapes"


def test_a_template_without_expressions_is_refused(model):
    nothing = np.zeros((0, len(model.skin.vertices), 3), np.float32)
    for basis in (None, ShapeBasis(nothing, nothing, ())):
        with pytest.raises(InputError) as error:
            template_shapes(model, basis)
        assert error.value.code == "tracks.no_shapes"


def test_what_moves_nothing_and_missing_teeth_are_told(model, shapes):
    still = {"still": np.zeros_like(shapes["aside"])}
    assert MuscleTracks.of(model, still).notices == ("still moves no skin on flesh",)
    toothless = replace(model, attached_mandible=np.zeros(0, np.int64), regions={})
    found = MuscleTracks.of(toothless, {"aside": shapes["aside"]})
    assert "no lower teeth" in found.notices[0]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"stiffness": {"lefty": 2.0}}, "tracks.muscle"),
        ({"stiffness": {"left": -1.0}}, "tracks.options"),
        ({"length_mm": 0.0}, "tracks.options"),
        ({"firmness": np.nan}, "tracks.options"),
        ({"law": "jelly"}, "tracks.options"),
        ({"bones": "loose"}, "tracks.options"),
    ],
)
def test_options_that_do_not_fit_are_refused(model, shapes, options, code):
    with pytest.raises(InputError) as error:
        MuscleTracks.of(model, shapes, TrackOptions(**options))
    assert error.value.code == code


def test_the_stiffness_of_a_muscle_is_given_by_its_name(model, shapes):
    tracks = MuscleTracks.of(model, shapes, TrackOptions(stiffness={"left": 3.0}))
    assert tracks.stiffness.tolist() == [3.0, 1.0]
