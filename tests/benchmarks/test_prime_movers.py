"""Prime movers of single units: shapes that a known muscle makes are found to be made by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.prime_movers import measure, single_units
from solver.anatomy.template import ShapeBasis
from solver.fitting.face import Face, Pose
from solver.mechanics.flesh import IDENTITY
from tests.solver.block import head_block

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
    assert (found["prime_mover_top3"], found["judged"]) == (0.5, 2)
