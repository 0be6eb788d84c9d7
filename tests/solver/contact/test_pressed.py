"""Contact in equilibrium: a ball pressed into a whole face, and the neutral left alone."""

from dataclasses import replace

import numpy as np
import pytest

from solver.contact import Gauge, contact_potentials
from solver.fitting.face import Face
from solver.mechanics.flesh import COROTATED_TRACE
from solver.similarity import IDENTITY
from solver.simulation import Simulator
from solver.simulation.forces import Drive
from tests.fixtures import small_model
from tests.solver.ball import ball

STIFFNESS_PA = 3000.0
RADIUS = 8.0
PRESSED = 3.0
STEPS = 3


@pytest.fixture(scope="module")
def nose():
    """A face, and a ball that begins half a millimetre in front of its nose."""
    model = small_model()
    face = Face(model, material=COROTATED_TRACE.in_pascal(STIFFNESS_PA))
    skin = model.skin.vertices[model.face]
    front = skin[skin[:, 2].argmax()]
    thing = ball(front + np.array([0.0, 0.0, RADIUS + 0.5]), RADIUS, 3)
    return model, face, thing


def pressed(model, face, thing, potentials):
    """Press the ball straight back: return where the face ends, and the ball."""
    density = np.full(len(model.tets), 1e-3)
    simulator = Simulator(face, potentials, [], dynamic=False, density=density)
    passive = face.flesh.passive()
    before = Drive(0.0, passive, np.zeros(5), IDENTITY, (thing.vertices,))
    motion = simulator.rest(before)
    for number in range(1, STEPS + 1):
        shift = np.array([0.0, 0.0, -(0.5 + PRESSED) * number / STEPS])
        here = thing.with_vertices(thing.vertices + shift)
        goal = replace(before, time=number / 30, objects=(here.vertices,))
        stepped = simulator.step(motion, before, goal)
        motion = stepped.motion
        before = goal
    return stepped.y, here


@pytest.mark.long
def test_a_ball_stays_out_of_the_flesh_it_is_pressed_into(nose):
    model, face, thing = nose
    gauge = Gauge(model)
    closed = np.zeros(5)
    x, here = pressed(model, face, thing, [])
    assert gauge.at(x, closed, [here]).objects == pytest.approx(PRESSED, abs=1.0)
    potentials = contact_potentials(model, STIFFNESS_PA, objects=[thing])
    x, here = pressed(model, face, thing, potentials)
    assert gauge.at(x, closed, [here]).most < 0.1
    assert face.flesh.count_inverted(x) == 0
    moved = np.linalg.norm(face.face_points(x) - face.face_points(model.rest), axis=1)
    assert PRESSED - 1.0 < moved.max() < PRESSED + 1.0
    # far from the ball nothing has happened
    assert np.median(moved) < 0.3


def test_the_neutral_stays_where_it_was(nose):
    model, face, thing = nose
    potentials = contact_potentials(model, STIFFNESS_PA, objects=[thing])
    simulator = Simulator(
        face, potentials, [], dynamic=False, density=np.full(len(model.tets), 1e-3)
    )
    drive = Drive(0.0, face.flesh.passive(), np.zeros(5), IDENTITY, (thing.vertices,))
    # where skin is nearer to skin than the barrier reaches it gives way, by hundredths
    assert np.abs(simulator.rest(drive).y - model.rest).max() < 0.04
