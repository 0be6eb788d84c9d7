"""Figures of a rig whose activations and jaw are known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.fit_quality import worst
from benchmarks.rig_figures import asymmetry, rig_figures, same_muscle_other_person
from benchmarks.subject_fits import Fits
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.fallback import FallbackFit
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.jaw_tracks import JawTracks
from solver.rig.report.prime_movers import movers
from tests.solver.block import block_model

PUSHES = np.array([1.3, 0.0, 0.0, 0.9, 0.0, 1.0])  # fibres along x lengthen


@pytest.fixture(scope="module")
def face() -> Face:
    block = block_model()
    along = np.where((block.weights.indices > 0)[:, None], [1.0, 0.0, 0.0], 0.0)
    return Face(replace(block, fibres=along))


def fits(face: Face, name: str, state: PosedFace) -> Fits:
    skin = face.whole_skin(state.x, state.pose.b)
    ending = FallbackFit(state, 0.0, 3, "reduced", "converged")
    return Fits(
        face, {name: face.model.skin.with_vertices(skin + 0.1)}, {name: ending}, 2.0, rounds=4
    )


def test_known_muscles_and_a_known_jaw(face: Face) -> None:
    pose = Pose(np.array([PUSHES, IDENTITY]), np.array([0.0, 0.0, 0.0, -0.2, 0.0]))
    train = fits(face, "smile", face.continuation(face.rest, pose))
    tracks = JawTracks(face.model.jaw, 0.0, 60.0, 20.0, 0.9)
    failed = replace(fits(face, "sad", face.rest), failed={"oo": "fit.failed"})
    found = rig_figures(train, failed, tracks)
    assert found["train_mean_mm"] == pytest.approx(0.1 * np.sqrt(3.0))
    assert (found["beyond"], found["beyond_worst"], found["inside_out"]) == (1, 1, 0)
    assert found["volume_worst_percent"] == pytest.approx(17.0)
    assert (found["fibres_longest"], found["stretch_longest"]) == pytest.approx((1.3, 1.3))
    assert found["condyle_out_mm"] == pytest.approx(0.2)
    assert found["expressions"]["smile"]["contractions"] == pytest.approx(
        {"left": -0.3, "right": 0}
    )
    assert (found["certificates_bad"], found["certificates"]) == (1, 3)
    assert found["round_trip"]["unreached"] == 0
    assert found["snap_max_mm"] < 0.01
    assert (found["rounds"], found["geometry_seconds"]) == (4, 2.0)
    assert found["bite_max_mm"] is None
    # pushing is beyond a bound, rest is at none
    assert (found["at_bound"], found["lengthened"], found["closers"]) == (1, 1, 0)
    assert found["expressions"]["sad"]["at_bound"] == 0
    assert found["asymmetry"] is None


def test_sides_are_compared_where_the_scan_is_alike_on_both() -> None:
    of_both = {"left mentalis": 0.3, "right mentalis": 0.24, "procerus": 0.4, "left risorius": 0.0}
    check = SimpleNamespace(movers=movers(of_both, {m: m for m in of_both}, ()), asymmetry_mm=0.1)
    assert asymmetry(check) == pytest.approx(0.06 / 0.4)
    check.asymmetry_mm = 3.0
    assert asymmetry(check) is None


def test_contractions_of_two_people_are_compared_by_expression_and_muscle() -> None:
    def person(**expressions: dict[str, float]) -> dict[str, object]:
        return {"expressions": {n: {"contractions": each} for n, each in expressions.items()}}

    one = person(smile={"a": 0.0, "b": 0.1, "c": 0.4}, sad={"a": 0.1, "b": 0.2})
    other = person(smile={"b": 0.2, "c": 0.5, "d": 0.9}, sad={"a": 0.3, "b": 0.1})
    assert same_muscle_other_person([one, other]) == pytest.approx(0.0)
    assert same_muscle_other_person([one, one, one]) == pytest.approx(1.0)
    assert same_muscle_other_person([one]) is None


def test_the_worst_subject_is_chosen_figure_by_figure() -> None:
    people = [
        {"mean": 1.0, "of": {"least": 0.2}, "rare": None},
        {"mean": 2.0, "of": {"least": 0.5}},
    ]
    rules = {"mean": max, "of": {"least": min}, "rare": max}
    assert worst(people, rules) == {"mean": 2.0, "of": {"least": 0.2}}
