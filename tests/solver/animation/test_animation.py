"""What drives a face over time: keys, recordings, heads and eyes."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.anatomy.template import ShapeBasis
from solver.animation import Gaze, HeadKey, KeyedDrives, PoseKey, RecordedDrives, neck
from solver.animation.blendshapes import (
    FORMAT,
    Blend,
    Blendshapes,
    Solved,
    expression_targets,
    solve_blendshapes,
    unfold,
)
from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.drives.admissible import (
    ADMISSIBLE,
    Admissible,
    AdmissibleSet,
    limits_by_plausibility,
)
from solver.fitting.drives.six_numbers import LEAST_STRETCH
from solver.fitting.face import Face, Pose
from solver.fitting.stretches import matrices
from solver.mechanics.flesh import IDENTITY
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.storage import Archive
from solver.surface import Floats
from tests.solver.block import block_model, divided_block, head_block
from tests.solver.simulation.test_fibres import fibred_block

MODEL = block_model()
REST = np.tile(IDENTITY, (2, 1))


def pose(change: float, jaw: float) -> Pose:
    """Return a pose in which both muscles are ``change`` longer along x."""
    a = REST.copy()
    a[:, 0] += change
    return Pose(a, np.array([jaw, 0.0, 0.0, 0.0, 0.0]))


POSES = {"smile": pose(-0.4, 0.0), "open": pose(0.1, 0.2)}


def test_poses_are_blended_linearly_from_rest() -> None:
    blend = Blend.of(POSES, 2)
    np.testing.assert_array_equal(blend.pose(np.zeros(2)).a, REST)
    np.testing.assert_allclose(blend.pose(np.array([0.0, 1.0])).a, POSES["open"].a)
    both = blend.pose(np.array([0.5, 0.5]))
    np.testing.assert_allclose(both.a[:, 0], 1.0 - 0.2 + 0.05)
    assert both.b[0] == pytest.approx(0.1)
    beyond = blend.pose(np.array([1.003, -0.1]))  # as recordings have it
    np.testing.assert_allclose(beyond.a, POSES["smile"].a)


def test_no_sum_folds_a_muscle() -> None:
    a = REST.copy()
    a[1, :3] = -0.3, 0.2, 0.1
    kept, count = unfold(a)
    assert count == 1
    np.testing.assert_array_equal(kept[0], REST[0])
    before, after = (np.linalg.eigh(matrices(each))[0][1] for each in (a, kept))
    assert before[0] < 0.0
    np.testing.assert_allclose(after, np.maximum(before, LEAST_STRETCH), atol=1e-12)


def test_keys_pass_through_their_values_and_never_beyond() -> None:
    squeezed = IDENTITY * 0.8
    keys = [
        PoseKey(0.5, {"smile": 0.0}),
        PoseKey(1.0, {"smile": 1.0}, {"right": squeezed}, np.array([0.1, 0.0, 0.0, 0.0, 0.0])),
        PoseKey(2.0, {"smile": 1.0, "open": 1.0}),
    ]
    drives = KeyedDrives(keys, POSES, MODEL, np.arange(60) / 30.0)
    np.testing.assert_array_equal(drives(0.0).a, REST)
    at_key = drives(1.0)
    np.testing.assert_allclose(at_key.a[0], POSES["smile"].a[0])
    np.testing.assert_allclose(at_key.a[1], POSES["smile"].a[1] + squeezed - IDENTITY)
    np.testing.assert_allclose(at_key.jaw, [0.1, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(drives(9.0).jaw[0], 0.2)  # the last key holds
    between = np.array([drives(time).a[0, 0] for time in np.linspace(0.5, 1.0, 30)])
    assert (np.diff(between) <= 0.0).all()
    linear = KeyedDrives(keys, POSES, MODEL, np.zeros(1), interpolation="linear")
    assert linear(0.75).a[0, 0] == pytest.approx(0.8)


def test_a_whole_muscle_moves_its_compartments() -> None:
    model = divided_block()
    squeezed = np.array([0.8, 0.0, 0.0, 1.0, 0.0, 1.0])
    keys = [PoseKey(0.0, {}, {"left.upper": IDENTITY, "left": squeezed})]
    a = KeyedDrives(keys, {}, model, np.zeros(1))(0.0).a
    np.testing.assert_array_equal(a, [squeezed, IDENTITY, IDENTITY, IDENTITY])
    contracted = [PoseKey(0.0, fibres={"right": 0.5})]
    names = model.muscle_names
    assert KeyedDrives(contracted, {}, model, np.zeros(1), fibres=names)(0.0).a.tolist() == [
        0,
        0,
        0.5,
        0.5,
    ]


@pytest.mark.parametrize(
    ("keys", "code", "where"),
    [
        ([PoseKey(0.0), PoseKey(0.0)], "scene.times", "keys[1]"),
        ([PoseKey(np.nan)], "scene.times", "keys[0]"),
        ([PoseKey(0.0), PoseKey(1e-320)], "scene.times", "keys[1]"),
        ([PoseKey(0.0), PoseKey(1.0, {"grin": 1.0})], "scene.expression", "keys[1]"),
        ([PoseKey(0.0, {}, {"tongue": IDENTITY})], "scene.muscle", "keys[0]"),
    ],
)
def test_keys_that_can_not_be(keys: list[PoseKey], code: str, where: str) -> None:
    with pytest.raises(InputError, match=re.escape(where)) as caught:
        KeyedDrives(keys, POSES, MODEL, np.zeros(1))
    assert caught.value.code == code


def test_the_head_turns_about_the_neck() -> None:
    turn = np.array([0.0, 0.4, 0.0])
    shift = np.array([0.0, 0.0, 7.0])
    head = [HeadKey(0.0, np.zeros(3), np.zeros(3)), HeadKey(1.0, turn, shift)]
    drives = KeyedDrives([], POSES, MODEL, np.zeros(1), head=head)
    np.testing.assert_allclose(drives(0.0).head.rotation, np.eye(3))
    moved = drives(1.0).head
    np.testing.assert_allclose(moved(neck(MODEL)[None])[0], neck(MODEL) + shift)
    assert np.degrees(0.4) == pytest.approx(moved.degrees)


def take(**weights: float) -> FaceTake:
    """Return three frames: at rest, with the weights, and with the weights again."""
    rows = np.zeros((3, len(ARKIT_NAMES)))
    for name, weight in weights.items():
        rows[1:, ARKIT_NAMES.index(name)] = weight
    head = np.zeros((3, 3))
    eyes = np.zeros((3, 2, 3))
    head[1:, 1] = 0.2
    eyes[1:, 1, 0] = -0.1
    times = np.array([0.0, 0.04, 0.07])
    return FaceTake(times, rows, head, eyes, np.ones(3, bool), "live_link")


def test_a_recording_drives_the_shapes_that_its_weights_are_called_after() -> None:
    shapes = Blendshapes(
        MODEL.muscle_names,
        {
            "browInnerUpLeft": Solved(POSES["smile"], 0.1),  # ARKit has one for both sides
            "browInnerUpRight": Solved(pose(0.1, 0.0), 0.1),
            "jawOpen": Solved(POSES["open"], 0.1),
        },
    )
    drives = RecordedDrives(take(browInnerUp=0.5, tongueOut=1.0), shapes, MODEL)
    np.testing.assert_allclose(drives.times, [0.0, 0.04, 0.07])
    np.testing.assert_allclose(drives.weights[1], [0.5, 0.5, 0.0])
    np.testing.assert_array_equal(drives(0.0).a, REST)
    np.testing.assert_allclose(drives(0.04).a[:, 0], 1.0 - 0.2 + 0.05)
    half = drives(0.02)
    np.testing.assert_allclose(half.a[:, 0], 1.0 - 0.075)
    np.testing.assert_allclose(half.eyes, [[0.0, 0.0, 0.0], [-0.05, 0.0, 0.0]])
    np.testing.assert_allclose(Rotation.from_matrix(half.head.rotation).as_rotvec()[1], 0.1)
    later = RecordedDrives(take(jawOpen=1.0), shapes, MODEL, 1)
    assert later.times[0] == 0.0
    assert later(0.0).jaw[0] == 0.2
    with pytest.raises(InputError) as caught:
        RecordedDrives(take(), shapes, MODEL, 2, 4)
    assert caught.value.code == "scene.frames"


def test_what_is_blended_stays_within_limits() -> None:
    """Two expressions within what muscles can do push, or shrink, where both are at full."""
    limits = AdmissibleSet(ADMISSIBLE, np.tile(np.diag([1.0, 0.0, 0.0]), (2, 1, 1)))
    poses = {"smile": pose(-0.35, 0.0), "grin": pose(-0.35, 0.0), "long": pose(0.015, 0.0)}
    poses = {name: replace(each, a=volume_kept(each.a)) for name, each in poses.items()}
    assert all(limits.contains(each.a) for each in poses.values())
    shapes = {name: Solved(each, 0.1) for name, each in poses.items()}
    both = Blendshapes(
        MODEL.muscle_names, {"mouthSmileLeft": shapes["smile"], "mouthFunnel": shapes["grin"]}
    )
    recorded = take(mouthSmileLeft=1.0, mouthFunnel=1.0)
    free = RecordedDrives(recorded, both, MODEL)(0.04)
    within = RecordedDrives(recorded, both, MODEL, limits=limits)(0.04)
    assert not limits.contains(free.a)
    assert limits.contains(within.a)
    assert within.clamped == 2
    keys = [PoseKey(0.0, {"long": 1.0}, {"left": IDENTITY + (poses["long"].a[0] - IDENTITY)})]
    keyed = KeyedDrives(keys, poses, MODEL, np.zeros(1), limits=limits)(0.0)
    assert limits.contains(keyed.a)
    assert keyed.clamped == 1  # the other one is as it was fitted
    np.testing.assert_array_equal(keyed.a[1], poses["long"].a[1])


def volume_kept(a: Floats) -> Floats:
    """Return activations along x with what makes up for their volume across it."""
    a = a.copy()
    a[:, 3] = a[:, 5] = a[:, 0] ** -0.5
    return a


def test_eyes_turn_about_their_centres() -> None:
    centre = np.array([30.0, 0.0, 80.0])
    ball = Rotation.random(200, rng=np.random.default_rng(1)).apply([12.0, 0.0, 0.0])
    vertices = np.vstack([MODEL.skin.vertices, ball + centre])
    ids = np.arange(len(MODEL.skin.vertices), len(vertices))
    model = replace(
        MODEL, skin=replace(MODEL.skin, vertices=vertices), regions={"left_eyeball": ids}
    )
    up = np.array([[-0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turned = Gaze(model).turn(vertices, up)
    np.testing.assert_array_equal(turned[: ids[0]], vertices[: ids[0]])
    front = int(ball[:, 2].argmax())
    assert turned[ids[front], 1] > vertices[ids[front], 1] + 3.0
    np.testing.assert_allclose(np.linalg.norm(turned[ids] - centre, axis=1), 12.0)


@pytest.mark.long
def test_blendshapes_are_solved_once(tmp_path: Path) -> None:
    model = head_block()
    face = Face(model)
    S = model.weights
    bulge = face.solve_equilibrium(pose(-0.2, 0.0), model.rest)
    opened = face.solve_equilibrium(pose(0.0, 0.1), model.rest)
    displaced = {
        "cheekPuffLeft": face.whole_skin(bulge.x, np.zeros(5)),
        "jawOpen": face.whole_skin(opened.x, opened.pose.b),
        "tongueOut": model.skin.vertices,  # moves nothing
        "cheekRaiserLeft": face.whole_skin(bulge.x, np.zeros(5)),  # not one of ARKit's
    }
    motions = np.array([skin - model.skin.vertices for skin in displaced.values()], np.float32)
    basis = ShapeBasis(np.zeros((0, *motions.shape[1:]), np.float32), motions, tuple(displaced))
    targets = expression_targets(model, basis)
    assert list(targets) == ["cheekPuffLeft", "jawOpen"]

    heard: list[str] = []
    shapes = solve_blendshapes(face, targets, {}, lambda name, _: heard.append(name))
    assert heard == list(targets)
    for name, points in targets.items():
        away = np.linalg.norm(points - model.skin.vertices[model.face], axis=1).mean()
        assert shapes.shapes[name].mean_mm < 0.2 * away
    file = tmp_path / "blendshapes.npz"
    shapes.save(file, model, S)
    with np.load(file, allow_pickle=False) as arrays:  # docs/guide/simulation.md
        assert arrays["names"].tolist() == list(targets)
        assert arrays["activations"].shape == (2, model.muscle_count, 6)
        assert {len(arrays[each]) for each in ("jaw", "mean_mm", "settled")} == {2}
    kept = Blendshapes.load(file, model, S)
    np.testing.assert_array_equal(kept.blend.activations, shapes.blend.activations)
    again = solve_blendshapes(face, targets, kept.shapes, lambda name, _: heard.append(name))
    assert len(heard) == 2
    assert again.shapes["jawOpen"] is kept.shapes["jawOpen"]
    wider = replace(model, rest=1.01 * model.rest)
    for other, weights in ((wider, S), (model, 0.5 * S)):
        with pytest.raises(InputError) as caught:
            Blendshapes.load(file, other, weights)
        assert caught.value.code == "blendshapes.model"


def test_shapes_that_a_release_before_kept_are_read(tmp_path: Path) -> None:
    """Its files had one hash of model and S together."""
    model = head_block()
    file = tmp_path / "blendshapes.npz"
    rest = np.tile(IDENTITY, (model.muscle_count, 1))
    shapes = Blendshapes(model.muscle_names, {"jawOpen": Solved(Pose(rest, np.zeros(5)), 0.1)})
    shapes.save(file, model, model.weights)
    kept = Archive.read(file, "blendshapes", "", FORMAT)
    S = model.weights
    digest = hashlib.sha256(model.sha256.encode())
    for array, kind in ((S.data, "<f8"), (S.indices, "<i8"), (S.indptr, "<i8")):
        digest.update(array.astype(kind).tobytes())
    del kept.header["of"]
    kept.header["rig"] = digest.hexdigest()
    kept.write(file)
    assert Blendshapes.load(file, model, S).shapes.keys() == shapes.shapes.keys()
    with pytest.raises(InputError, match="another rig"):
        Blendshapes.load(file, model, 0.5 * S)


def test_a_corrective_that_was_solved_at_another_weight_is_left_out(tmp_path: Path) -> None:
    model = head_block()
    file = tmp_path / "blendshapes.npz"
    solved = Solved(Pose(np.tile(IDENTITY, (model.muscle_count, 1)), np.zeros(5)), 0.1)
    names = ("jawOpen", "mouthClose")
    Blendshapes(model.muscle_names, dict.fromkeys(names, solved)).save(file, model, model.weights)
    assert Blendshapes.load(file, model, model.weights).names == names
    before = Archive.read(file, "blendshapes", "", FORMAT)
    del before.header["corrected_at"]
    before.write(file)
    kept = Blendshapes.load(file, model, model.weights)
    assert (kept.names, kept.outdated) == (("jawOpen",), ("mouthClose",))


def opened_block() -> tuple[Face, dict[str, np.ndarray]]:
    """Return a face within limits, and the changes of its controls of shapes that are far off."""
    face = Face(fibred_block()).driven_as(Admissible(limits_by_plausibility(1.0)))
    places = face.layout.places("jaw")
    change = np.zeros((2, face.layout.size))
    change[0, places[0]] = 0.2
    change[1, places[0]] = -0.1
    return face, {"jawOpen": change[0], "mouthClose": change[1]}


def test_shapes_begin_with_what_is_known_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """A corrective begins half way with the shape it corrects, and both end where they did."""
    face, known = opened_block()
    poses = {
        "jawOpen": face.rest_pose().add(known["jawOpen"]),
        "mouthClose": face.rest_pose().add(known["jawOpen"] + known["mouthClose"]),
    }
    targets = {
        name: face.face_points(face.continuation(face.rest, there).x)
        for name, there in poses.items()
    }
    whole_fit = activation.fit
    begun = []

    def fit(*given: Any, **how: Any) -> activation.ActivationFit:
        begun.append(given[3])
        return whole_fit(*given, **how)

    cold = solve_blendshapes(face, targets, {}, lambda _name, _solved: None)
    monkeypatch.setattr(activation, "fit", fit)
    warm = solve_blendshapes(face, targets, {}, lambda _name, _solved: None, known)
    half = face.rest_pose().add(0.5 * (known["jawOpen"] + known["mouthClose"]))
    for state, there in zip(begun, (poses["jawOpen"], half), strict=True):
        np.testing.assert_allclose(state.pose.vector(), there.vector(), atol=1e-12)
    for name, shape in warm.shapes.items():
        assert shape.mean_mm < cold.shapes[name].mean_mm + 0.01
        np.testing.assert_allclose(shape.pose.b, cold.shapes[name].pose.b, atol=0.02)
    limits = face.layout.bounds.feasible
    assert limits is not None
    assert limits.contains(warm.shapes["jawOpen"].pose.a)
    assert warm.shapes["mouthClose"].pose.b[0] == pytest.approx(-0.1, abs=0.02)  # at weight 1


def test_shapes_of_a_rig_within_limits_are_within_them(tmp_path: Path) -> None:
    """Two shapes are made by muscles that push along their fibres, as none can."""
    model = fibred_block()
    drive = Admissible(limits_by_plausibility(1.0))
    face = Face(model)
    push = np.tile([0.35, 0.0, 0.0, -0.1, 0.0, -0.1], (2, 1))
    targets = {}
    for name, sign in (("cheekPuffLeft", 1.0), ("jawOpen", 0.7)):
        there = Pose(REST + sign * push, np.array([0.1 * sign, 0.0, 0.0, 0.0, 0.0]))
        targets[name] = face.face_points(face.continuation(face.rest, there).x)
    limits = face.driven_as(drive).layout.bounds.feasible
    assert limits is not None
    free, within = (
        solve_blendshapes(each, targets, {}, lambda _name, _solved: None)
        for each in (face, face.driven_as(drive))
    )
    assert not any(limits.contains(a) for a in free.blend.activations)
    assert all(limits.contains(a) for a in within.blend.activations)
    assert within.blend.jaw.shape == (2, 5)
    within.save(tmp_path / "blendshapes.npz", model, model.weights)
    assert Blendshapes.load(tmp_path / "blendshapes.npz", model, model.weights).drive == drive


def test_a_template_without_expressions_can_not_be_driven() -> None:
    for basis, code in (
        (None, "blendshapes.none"),
        (
            ShapeBasis(
                np.zeros((0, *MODEL.skin.vertices.shape), np.float32),
                np.ones((1, *MODEL.skin.vertices.shape), np.float32),
                ("cheekRaiserLeft",),
            ),
            "blendshapes.none",
        ),
        (
            ShapeBasis(
                np.zeros((0, 9, 3), np.float32), np.ones((1, 9, 3), np.float32), ("jawOpen",)
            ),
            "blendshapes.topology",
        ),
    ):
        with pytest.raises(InputError) as caught:
            expression_targets(MODEL, basis)
        assert caught.value.code == code
