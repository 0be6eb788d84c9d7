"""Flesh in motion against known answers: equilibria, momentum, moving heads, things in the way."""

import numpy as np

from solver.fitting.face import Face
from solver.mechanics.flesh import COROTATED_TRACE
from solver.similarity import IDENTITY
from solver.simulation.simulator import Simulator
from solver.simulation.state import Drive
from tests.unit.solver.block import block_model, poses

PASCAL = 3000.0
EXACT = {"tolerance": 1e-9, "settled_mm": 0.0, "linear": "superlu"}


def face_of(model=None, **changes):
    return Face(model or block_model(), material=COROTATED_TRACE.in_pascal(PASCAL), **changes)


def simulator(face, potentials=(), forces=(), *, dynamic=False, **options):
    density = np.full(len(face.model.tets), 1e-3)
    options = EXACT | {"damping": 0.0} | options
    return Simulator(face, potentials, forces, dynamic=dynamic, density=density, **options)


def drive(face, pose, time=0.0, head=IDENTITY, objects=()):
    A = face.tet_activations(face.model.weights, pose.a)
    return Drive(time, A, pose.b, head, objects)


def test_quasi_static_steps_end_in_the_equilibria_of_a_fit():
    face = face_of()
    pose = poses(1)[0]
    steps = simulator(face)
    neutral = drive(face, face.rest_pose())
    motion = steps.rest(neutral)
    np.testing.assert_allclose(motion.x, face.model.rest, atol=1e-6)
    stepped = steps.step(motion, neutral, drive(face, pose, 1.0))
    S = face.model.weights
    settled = face.move(S, face.rest_state(S), pose)
    assert np.abs(settled.x - face.model.rest).max() > 3.0
    np.testing.assert_allclose(stepped.y, settled.x, atol=1e-5)
    assert stepped.inverted == stepped.halvings == 0
    assert not stepped.motion.v.any()
