"""The sliders: every fit can be reached, and the reduced skin is near the simulated one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting.drives.admissible import ADMISSIBLE
from solver.fitting.face import Face, Pose
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig
from solver.rig.frames.skin_basis import feature_slopes, features
from solver.rig.preview.poses import Responses, SampleOptions, SliderSolver
from solver.rig.preview.sliders import SliderOptions, Sliders, controls_of
from solver.rig.report.certificate import certify
from tests.solver.block import head_block

BLOCK = head_block((7, 5, 1))
S = BLOCK.weights
MODEL = replace(BLOCK, fibres=np.where(S.indices[:, None] > 0, [1.0, 0.0, 0.0], 0.0))
EXPRESSIONS = {
    "wide": ([[0.8, 0.02, 0, 1.1, 0, 1.1], [0.95, 0, 0, 1, 0.01, 1]], [0.06, 0, 0, 0, 0.5]),
    "narrow": ([[0.95, 0, 0.03, 1, 0, 1], [0.75, 0.02, 0, 1.1, 0, 1.2]], [-0.02, 0, 0, 0, 0]),
}


@pytest.fixture(scope="module")
def face() -> Face:
    return Face(MODEL)


@pytest.fixture(scope="module")
def fits(face: Face) -> list[ExpressionFit]:
    return [
        fitted(face, name, np.array(a, float), np.array(b, float))
        for name, (a, b) in EXPRESSIONS.items()
    ]


def fitted(face: Face, name: str, a: np.ndarray, b: np.ndarray) -> ExpressionFit:
    x = face.continuation(face.rest, Pose(a, b)).x
    skin = face.whole_skin(x, b)
    zero = np.zeros(len(skin))
    return ExpressionFit(name, "train", a, b, skin, skin, zero, 0, 1, 0.0, 0.0, x)


@pytest.fixture(scope="module")
def controls(face: Face, fits: list[ExpressionFit]) -> Sliders:
    return controls_of(face, fits)


def test_a_preset_is_the_pose_of_its_fit(controls: Sliders, fits: list[ExpressionFit]) -> None:
    for fit in fits:
        values = controls.presets[fit.name]
        pose = controls.pose(values)
        assert np.allclose(pose.a, fit.activations)
        assert np.allclose(pose.b, fit.jaw)
        assert (values >= 0.0).all()
        assert (values <= 1.0).all()
    ways = [controls.each[number].name for number in controls.of_kind("jaw")]
    assert ways == ["jaw_opens", "jaw_closes", "jaw_moves_forward", "jaw_moves_back"]


def test_a_muscle_shortens_along_its_fibres_and_keeps_its_volume(controls: Sliders) -> None:
    muscles = controls.of_kind("muscle")
    assert [controls.each[number].muscle for number in muscles] == list(MODEL.muscle_names)
    for muscle, number in enumerate(muscles):
        for amount in (0.25, 0.5, 0.75, 1.0):
            a = controls.pose(amount * np.eye(len(controls))[number]).a
            xx, xy, xz, yy, yz, zz = a[muscle]
            stretch = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert xx == pytest.approx(1.0 - amount * (1.0 - SliderOptions().full_stretch))
            # on the way, within what muscles can do
            assert np.linalg.det(stretch) == pytest.approx(1.0, abs=ADMISSIBLE.volume - 1.0)
            assert np.allclose(np.delete(a, muscle, axis=0), IDENTITY)
        assert np.linalg.det(stretch) == pytest.approx(1.0)


def test_muscles_without_fibres_have_no_slider(face: Face) -> None:
    at_rest = fitted(face, "rest", np.tile(IDENTITY, (MODEL.muscle_count, 1)), np.zeros(5))
    bare = controls_of(Face(BLOCK), [at_rest])
    assert [control.kind for control in bare.each] == ["jaw", "expression"]


def test_a_preset_tells_who_contracts_as_the_certificate_does(face: Face) -> None:
    a = np.array([[0.8, 0.02, 0, 1.1, 0, 1.1], [1.05, 0, 0, 1, 0.01, 1]])
    smile = fitted(face, "smile", a, np.array([0.0, 0.0048, 0.0, 0.0, 0.0]))
    found = controls_of(face, [smile])
    muscles, [turned] = (
        found.of_kind("muscle"),
        [k for k, each in enumerate(found.each) if each.name == "jaw_turns_left"],
    )
    judged = certify(face, Rig(MODEL, MODEL.weights, (smile,)), {}).expressions["smile"]
    told = [judged.movers.contractions[str(found.each[number].muscle)] for number in muscles]
    full = 1.0 - SliderOptions().full_stretch
    # one at the bound of its fibres holds still
    assert told == pytest.approx([0.2, -0.05])
    values = found.presets["smile"]
    assert values[muscles] == pytest.approx([0.2 / full, 0.0])
    # half a millimetre at the chin is no turned jaw
    assert 0.0 < values[turned] < 0.1
    of_jaw = [found.each[number] for number in found.of_kind("jaw")]
    by_jaw = np.clip([np.dot(control.by_jaw or (), smile.jaw) for control in of_jaw], 0.0, 1.0)
    assert values[found.of_kind("jaw")] == pytest.approx(by_jaw)


def test_slopes_of_the_skin_are_its_differences(face: Face, controls: Sliders) -> None:
    rng = np.random.default_rng(2)
    modes = rng.normal(size=(3, *MODEL.skin.vertices.shape))
    simulator = SliderSolver(face, controls, face.rest, {})
    slid = next(pose for pose in SampleOptions().to_learn(controls, 0) if pose.sort == "plausible")
    (sample,) = simulator.solve([slid], np.inf, lambda _: None)
    slopes = Responses(face, controls, modes).at(sample)
    assert slopes is not None
    step = 1e-2
    start = face.continuation(face.rest, controls.pose(slid.values))
    for number, unit in enumerate(np.eye(len(controls))):
        ahead, behind = (
            face.continuation(start, controls.pose(slid.values + way * unit))
            for way in (step, -step)
        )
        skins = [face.whole_skin(state.x, state.pose.b) for state in (ahead, behind)]
        rate = np.tensordot(modes, (skins[0] - skins[1]) / (2 * step), 2)
        assert np.allclose(rate, slopes[:, number], rtol=1e-2, atol=0.02)


def test_slopes_of_the_features_are_their_differences() -> None:
    values = np.array([0.2, 0.5, 0.9])
    pairs = np.triu_indices(3)
    assert list(zip(*pairs, strict=True)) == [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    slopes = feature_slopes(values, pairs).toarray()
    for number, unit in enumerate(np.eye(3)):
        ahead, behind = (features((values + step * unit)[None], pairs) for step in (1e-6, -1e-6))
        assert np.allclose((ahead - behind)[0] / 2e-6, slopes[number])


def test_nothing_is_measured_on_what_was_learned_from(controls: Sliders) -> None:
    learned = {pose.values.tobytes() for pose in SampleOptions().to_learn(controls, 3)}
    measured = SampleOptions().to_measure(controls, 3)
    assert learned.isdisjoint(pose.values.tobytes() for pose in measured)
    assert {pose.about for pose in measured if pose.sort == "alone"} == {
        control.name for control in controls.each
    }
    values = np.array([pose.values for pose in measured])
    assert values.min() >= 0.0
    assert values.max() <= 1.0
