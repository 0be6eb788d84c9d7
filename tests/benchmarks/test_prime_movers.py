"""Prime movers of single units: shapes that a known muscle makes are found to be made by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.prime_movers import (
    has_unit,
    held_out_units,
    measure,
    measure_mixtures,
    single_summary,
    single_units,
    summarised,
    without_held_out,
)
from benchmarks.rig_figures import pulling_closers
from solver.anatomy.template import ShapeBasis
from solver.fitting.face import Face, Pose
from solver.mechanics.flesh import IDENTITY
from solver.model import Expressions
from solver.rig.report.certificate import JawFigures, muscles
from tests.solver.block import block_model, head_block

PULL = np.array([0.75, 0.0, 0.0, 1.15, 0.0, 1.15])


def test_the_muscle_that_made_a_shape_is_found() -> None:
    block = head_block((7, 5, 1))
    along = np.tile([1.0, 0.0, 0.0], (len(block.weights.data), 1))
    names = ("zygomaticus_major_l", "mentalis_r")
    face = Face(replace(block, muscle_names=names, fibres=along))
    skin = face.model.skin.vertices
    moved = []
    for muscle in (0, 1):
        a = np.tile(IDENTITY, (2, 1))
        a[muscle] = PULL
        pose = Pose(a, np.zeros(5))
        moved.append(face.whole_skin(face.continuation(face.rest, pose).x, pose.b) - skin)
    # a smile by another muscle, a unit whose muscle the block lacks, a corrective, and a look
    shapes = {
        "mouthSmileLeft": moved[0],
        "mouthShrugLower": moved[0],
        "noseSneerLeft": moved[1],
        "mouthClose": moved[1],
        "eyeLookUpLeft": moved[1],
    }
    expressions = np.array([*shapes.values()], np.float32)
    basis = ShapeBasis(np.zeros((0, *skin.shape), np.float32), expressions, tuple(shapes))
    scans = single_units(face.model, basis)
    assert set(scans) == {"mouthSmileLeft", "mouthShrugLower", "noseSneerLeft"}
    found = measure(face, scans)
    assert found["failed"] == {}
    primes = {name: shape["prime"] for name, shape in found["shapes"].items()}
    assert primes == {"mouthSmileLeft": True, "mouthShrugLower": False, "noseSneerLeft": None}
    assert found["shapes"]["mouthSmileLeft"]["named"]["zygomaticus_major_l"] > 0.1
    assert found["shapes"]["noseSneerLeft"]["missing"] == ["levator labii superioris alaeque nasi"]
    summary = single_summary(found["shapes"].values())
    assert (summary["prime_mover_top3"], summary["judged"]) == (0.5, 2)
    # a mixture of both: the smile has its muscle, the chin contracts for the unit of no muscle
    weights = {"mouthSmileLeft": 1.0, "noseSneerLeft": 1.0}
    both = face.model.skin.with_vertices(skin + moved[0] + moved[1])
    mixture = measure_mixtures(face, {"both": both}, {"both": weights})["shapes"]["both"]
    assert mixture["units"] == {"AU 12 left": True}
    assert set(mixture["others"]) == {"mentalis_r"}
    assert 0.3 < mixture["unnamed"] / mixture["contraction"] < 0.7
    found = summarised({"parts": {"units": found["shapes"], "drawn": {"both": mixture}}})
    assert (found["judged"], found["closers"], found["drawn"]["units_contract"]) == (2, 0, 1.0)


def test_held_out_units_are_unknown_to_the_model() -> None:
    names = ("browInnerUp", "mouthSmileLeft", "mouthSmileRight", "noseSneerLeft", "eyeLookUpLeft")
    wholes = ("frontalis", "zygomaticus_major", "levator_labii_superioris_alaeque_nasi")
    block = replace(block_model(), muscle_names=wholes)
    motions = np.arange(len(names), dtype=np.float32)[:, None, None] * np.ones((len(block.face), 3))
    model = replace(block, expressions=Expressions(names, motions.astype(np.float32)))
    known = without_held_out(model).expressions
    assert known is not None
    # AU 1, AU 9 and AU 12, of which the second is held out
    assert known.names == ("browInnerUp", "mouthSmileLeft", "mouthSmileRight", "eyeLookUpLeft")
    assert known.motions[:, 0, 0].tolist() == [0.0, 1.0, 2.0, 4.0]
    assert has_unit("noseSneerLeft", held_out_units(names, wholes))


def test_jaw_closers_are_silent_in_an_open_jaw_alone() -> None:
    block = head_block((7, 5, 1))
    along = np.tile([1.0, 0.0, 0.0], (len(block.weights.data), 1))
    names = ("masseter_deep_l.anterior", "mentalis_l")
    wholes = ("masseter_deep_l", "mentalis_l")
    model = replace(block, muscle_names=names, wholes=wholes, fibres=along)
    face = Face(model)
    found = muscles(model, face.flesh.volumes, face.S, np.array([PULL, PULL]))
    still = JawFigures("chin", 3.0, 4.0, 0.0, 0.0, 0.0)
    assert pulling_closers(model, found, still) == {}
    opened = replace(still, opening_mm=12.0)
    assert pulling_closers(model, found, opened) == pytest.approx({names[0]: 0.25})
