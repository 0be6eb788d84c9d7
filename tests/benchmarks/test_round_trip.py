"""Named mixtures found again: the muscles that texts name contract, and correlations tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import round_trip
from benchmarks.round_trip import found_again, named_pose, simulate
from benchmarks.subject_fits import by_activations
from solver.fitting.contraction import Contraction
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from tests.solver.block import head_block


def test_muscles_of_a_mixture_come_back(monkeypatch: pytest.MonkeyPatch) -> None:
    block = head_block((7, 5, 1))
    along = np.tile([1.0, 0.0, 0.0], (len(block.weights.data), 1))
    names = ("zygomaticus_major_l", "zygomaticus_major_r")
    face = Face(replace(block, muscle_names=names, fibres=along)).driven_by(Admissible())
    smile = {"mouthSmileLeft": 0.7}
    pose = named_pose(face, smile, np.random.default_rng(0))
    contraction = Contraction.of_face(face)
    assert contraction is not None
    left, right = contraction(pose.a)
    assert 0.05 < left < 0.35
    assert right == 0.0
    # a fit that mistakes both sides
    turned = {"mouthSmileRight": 0.7}
    wrong = named_pose(face, turned, np.random.default_rng(0))
    there = face.continuation(face.rest, wrong)
    skin = face.model.skin.with_vertices(face.whole_skin(there.x, wrong.b))
    told = dict(round_trip.TOLD)
    told["nonsense"] = lambda face, scans, _: by_activations(face, dict.fromkeys(scans, skin))
    monkeypatch.setattr(round_trip, "TOLD", told)
    found = found_again(face, simulate(face, {"smile": smile}))
    assert found["skin and anatomy"]["correlation"] == pytest.approx(1.0, abs=1e-6)
    assert found["skin and anatomy"]["contraction_rms"] < 0.05
    assert found["nonsense"]["correlation"] == pytest.approx(-1.0, abs=1e-6)
    assert found["skin and anatomy"]["unreached"] == 0
