"""The certificate: what it measures is so, and what is wrong with a fit shows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.sparse as sp
import trimesh

from solver.fitting.face import Face, Pose, PosedFace
from solver.mechanics.flesh import IDENTITY
from solver.rig import ExpressionFit, Rig
from solver.rig.report import report
from solver.rig.report.certificate import certify, check_flesh, with_round_trips
from solver.rig.report.checks import CHECKS, Judgement, RigCheck, judge, overall, use
from solver.rig.report.measures import Measure
from solver.rig.round_trip import activation_error
from solver.surface import Surface
from tests.solver.block import block_model

PULL = np.array([[0.75, 0.05, 0.0, 1.1, 0.0, 1.1], [1.1, 0.0, 0.05, 0.8, 0.0, 1.1]])
JAW = np.array([0.06, 0.02, 0.3, 0.0, 0.5])


@pytest.fixture(scope="module")
def face() -> Face:
    return Face(block_model())


@pytest.fixture(scope="module")
def S(face: Face) -> sp.csr_array:
    return face.model.weights


@pytest.fixture(scope="module")
def state(face: Face) -> PosedFace:
    return face.continuation(face.rest, Pose(PULL, JAW))


def fitted(face: Face, state: PosedFace, name: str = "smile") -> ExpressionFit:
    skin = face.whole_skin(state.x, state.pose.b)
    return ExpressionFit(
        name=name,
        role="train",
        activations=state.pose.a,
        jaw=state.pose.b,
        skin=skin,
        target=skin,
        error_mm=np.full(len(skin), 0.2),
        inverted=face.flesh.count_inverted(state.x),
        iterations=3,
        seconds=0.1,
        objective=0.04,
        x=state.x,
    )


def volumes(face: Face, x: np.ndarray) -> np.ndarray:
    corners = x[face.model.tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0


def test_flesh_at_rest_in_its_equilibrium(face: Face, state: PosedFace) -> None:
    a = face.flesh_controls(state.pose.a)
    found = check_flesh(face, a, state.x, face.linear)
    ratio = volumes(face, state.x) / volumes(face, face.model.rest)
    assert found.residual <= 1e-7
    assert found.minimum
    assert found.inverted == 0
    assert (found.det_least, found.flattest) == (pytest.approx(ratio.min()), ratio.argmin())
    assert (found.det_most, found.swollen) == (pytest.approx(ratio.max()), ratio.argmax())
    whole = volumes(face, state.x).sum() / volumes(face, face.model.rest).sum()
    assert abs(whole - 1.0) > 1e-3
    assert found.volume_percent == pytest.approx(100.0 * (whole - 1.0))


def test_flesh_that_s_has_outside_its_muscle_is_told(face: Face, state: PosedFace) -> None:
    model = face.model
    border = 15.0
    box = trimesh.creation.box(bounds=[[-1.0, -1.0, -1.0], [border, 41.0, 16.0]])
    surfaces = {"left": Surface(np.array(box.vertices), np.array(box.faces, np.int64))}
    face = Face(replace(model, muscles=surfaces))
    rig = Rig(face.model, face.S, (fitted(face, state),), {})
    certificate = certify(face, rig, {})
    flesh = face.S[:, [1]].toarray()[:, 0] * volumes(face, model.rest)
    outside = model.tet_centres[:, 0] > border + 5.0
    expected = flesh[outside].sum() / flesh.sum()
    assert 0.1 < expected < 0.9
    assert certificate.strayed == {"left": pytest.approx(expected)}
    judged = {each.check.code: each for each in judge(rig, certificate)}
    found = judged["muscles.strayed"]
    assert (found.worst, found.verdict) == ("all expressions", "usable")
    assert "smile" not in found.measures
    figures = report(rig, certificate)
    assert figures["strayed"] == {"left": pytest.approx(expected, abs=1e-4)}
    words = f"left has {100.0 * expected:.0f} % of its flesh outside"
    assert next(each["says"] for each in figures["checks"] if each["code"] == found.check.code) == (
        words
    )


def test_flesh_out_of_its_equilibrium(face: Face, state: PosedFace) -> None:
    a = face.flesh_controls(state.pose.a)
    moved = state.x.copy()
    moved[face.flesh.free[0]] += [0.5, 0.0, 0.0]
    assert check_flesh(face, a, moved, face.linear).residual > 1e-3
    moved[face.flesh.free[0]] += [60.0, 0.0, 0.0]
    assert check_flesh(face, a, moved, face.linear).inverted > 0


def test_a_round_trip_comes_home(face: Face, state: PosedFace) -> None:
    fit = fitted(face, state)
    other = replace(fit, name="buckled", skin=fit.skin + np.array([0.0, 0.0, 1.0]))
    home, buckled = with_round_trips(face, (fit, other))
    assert home.round_trip is not None
    assert buckled.round_trip is not None
    assert home.round_trip.skin_max_mm < 1e-3
    assert home.round_trip.refit_mean_mm < 0.05
    assert 0.0 < home.round_trip.activation_error < 0.1
    assert buckled.round_trip.skin_mean_mm == pytest.approx(1.0, abs=1e-3)
    asked: list[str] = []
    again = with_round_trips(face, (home,), lambda name, _: asked.append(name))
    assert again[0].round_trip is home.round_trip
    assert asked == []


def test_an_activation_out_of_reach_is_told(face: Face, state: PosedFace) -> None:
    wild = np.array([[-0.2, 0.0, 0.0, 1.0, 0.0, 1.0], [1.0, 0.0, 0.0, -0.2, 0.0, 1.0]])
    fit = replace(fitted(face, state), activations=wild, jaw=np.array([0.0, 0.0, 0.0, 6000.0, 0.0]))
    fits = with_round_trips(face, (fit,))
    assert fits[0].round_trip is not None
    assert not fits[0].round_trip.is_reached
    rig = Rig(face.model, face.S, fits, {})
    judged = {each.check.code: each for each in judge(rig, certify(face, rig, {}))}
    assert judged["trip.skin"].verdict == "bad"
    assert judged["muscles.inside_out"].measures["smile"].detail == "left, right"
    assert "trip.refit" not in judged


def test_only_excited_muscles_count() -> None:
    a = np.array([[0.8, 0.0, 0.0, 1.0, 0.0, 1.0], IDENTITY])
    found = a + np.array([[0.02, 0.0, 0.0, 0.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert activation_error(a, found) == pytest.approx(0.1)
    assert np.isnan(activation_error(np.tile(IDENTITY, (2, 1)), found))
    fibres = np.array([0.5, 0.01])
    rest = np.zeros(2)
    again = np.array([0.45, 0.3])
    assert activation_error(fibres, again, rest=rest) == pytest.approx(0.1)


def test_the_worst_expression_decides(face: Face, state: PosedFace) -> None:
    good = fitted(face, state)
    poor = replace(good, name="sad", error_mm=np.full(len(good.skin), 0.6), x=None)
    rig = Rig(face.model, face.S, (good, poor), {})
    judged = {each.check.code: each for each in judge(rig, certify(face, rig, {}))}
    mean = judged["skin.mean"]
    assert (mean.worst, mean.verdict, mean.of("smile")) == ("sad", "usable", "good")
    assert set(judged["flesh.residual"].measures) == {"smile"}
    assert "trip.skin" not in judged


def test_it_says_which_expressions_may_be_used(face: Face, state: PosedFace) -> None:
    good = fitted(face, state)
    torn = replace(good, name="sad", error_mm=np.full(len(good.skin), 3.0))

    def said(*fits: ExpressionFit) -> str:
        rig = Rig(face.model, face.S, fits, {})
        return str(report(rig, certify(face, rig, {}))["use"])

    assert said(good).startswith("Ready for animation")
    assert said(good, torn).startswith("Ready for animation without sad")
    assert said(torn).startswith("Not ready for animation, since every expression fails a check")


def test_the_worst_muscle_is_named_with_how_many_are_no_effort(
    face: Face, state: PosedFace
) -> None:
    def told(**activations: list[np.ndarray | list[float]]) -> dict[str, Any]:
        fits = [
            replace(fitted(face, state, name), activations=np.array(a), jaw=np.zeros(5), x=None)
            for name, a in activations.items()
        ]
        rig = Rig(face.model, face.S, tuple(fits), {})
        return report(rig, certify(face, rig, {}))

    short, shorter = ([least, 0.0, 0.0, 1.4, 0.0, 1.4] for least in (0.48, 0.4))
    one = told(smile=[short, IDENTITY], sad=[IDENTITY, IDENTITY])
    assert one["verdict"] == "usable"
    assert one["use"] == (
        "Ready for animation; one muscle is not to be read as effort "
        "(in smile: left shrinks to 48 % in one direction)."
    )
    many = told(smile=[short, short], sad=[IDENTITY, shorter])
    assert many["limits"] == [
        {
            "words": "2 muscles are not to be read as effort "
            "(worst in sad: right shrinks to 40 % in one direction)",
            "code": "muscles.beyond",
            "expression": "sad",
        }
    ]


def test_left_is_judged_against_right_where_the_scan_is_alike(face: Face) -> None:
    model = replace(face.model, muscle_names=("orbicularis_l", "orbicularis_r"))
    model = replace(model, fibres=np.tile([1.0, 0.0, 0.0], (len(model.weights.data), 1)))
    pulled = Face(model)
    a = np.array([[0.87, 0.0, 0.0, 1.0, 0.0, 1.0], [0.63, 0.0, 0.0, 1.0, 0.0, 1.0]])
    skin = model.skin.vertices
    kiss = fitted(pulled, pulled.rest, "kiss")
    kiss = replace(kiss, activations=a, skin=skin, target=skin + np.array([0.0, 2.0, 1.0]), x=None)
    side = np.sign((skin - model.jaw.origin) @ model.jaw.axes[0])[:, None]
    twisted = replace(kiss, name="smirk", target=skin + side * [0.0, 2.0, 0.0])
    rig = Rig(model, model.weights, (kiss, twisted), {})
    certificate = certify(pulled, rig, {})
    judged = {each.check.code: each for each in judge(rig, certificate)}
    told = report(rig, certificate)["expressions"]
    assert [len(told[name]["movers"]["uneven"]) for name in ("kiss", "smirk")] == [1, 0]
    sides = judged["muscles.sides"]
    assert set(sides.measures) == {"kiss"}
    assert (sides.verdict, sides.measures["kiss"].value) == ("usable", pytest.approx(24.0))
    assert sides.measures["kiss"].detail == (
        "orbicularis_r contracts by 37 %, orbicularis_l by 13 %"
    )


def test_a_bad_rig_is_not_called_ready() -> None:
    [check] = (check for check in CHECKS if check.code == "flesh.minimum")
    [skin] = (check for check in CHECKS if check.code == "skin.mean")
    snaps = Judgement(check, "smile", {"smile": Measure(1.0), "sad": Measure(0.0)})
    off = Judgement(skin, "sad", {"smile": Measure(0.0), "sad": Measure(9.0)})
    assert overall([snaps.verdict]) == "bad"
    names = ["smile", "sad"]
    assert use([snaps], names).startswith("To be used for animation alone; simulations are not")
    assert use([snaps, off], names).startswith("To be used for animation alone, without sad; ")


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.code)
def test_advice_names_the_option_of_the_job(check: RigCheck) -> None:
    assert "{" not in check.advise({})
    assert check.advise({"max_iterations": 25}).count("max_iterations 50 instead of 25") == (
        check.advice.count("{longer}")
    )


def test_training_scans_tell_of_the_muscles_that_they_move(face: Face, S: sp.csr_array) -> None:
    pose = Pose(np.vstack([PULL[0], IDENTITY]), JAW)
    fit = fitted(face, face.continuation(face.rest, pose))
    unseen = replace(fit, name="test", role="test")
    found = report(rig := Rig(face.model, S, (fit, unseen)), certify(face, rig, {}))["information"]
    assert found["scans"] == 1
    assert found["muscles"]["left"] > 0.2
    assert found["muscles"]["right"] == 0.0
    assert found["confused"] == []
    none = Rig(face.model, S, (unseen, replace(fit, x=None), replace(fit, status="failed")))
    assert report(none, certify(face, none, {}))["information"] is None
