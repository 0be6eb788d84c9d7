"""Forces from outside: their sums are known."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.face import Face
from solver.similarity import IDENTITY, small_motion
from solver.simulation.forces import AIR, DRAG, FleshMotion, Gravity, Pull, Wind, lumped_masses
from solver.surface import Surface
from tests.solver.block import head_block

TURNED = small_motion(np.array([0.0, 0.0, np.pi / 2, 10.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def face():
    return Face(head_block())


def motion(face, head=IDENTITY, v=(0.0, 0.0, 0.0)):
    x = head(face.model.rest)
    return FleshMotion(x, np.tile(v, (len(x), 1)), head)


def test_weight_is_that_of_the_flesh_less_what_was_scanned(face):
    masses = lumped_masses(face.flesh, np.full(len(face.model.tets), 1e-3))
    grams = 1e-3 * face.flesh.volumes.sum()
    assert masses.sum() == pytest.approx(grams)
    gravity = Gravity(masses)
    assert not gravity.at(motion(face), 0.0).any()
    lying = gravity.at(motion(face, TURNED), 0.0).sum(axis=0)
    np.testing.assert_allclose(lying, grams * 9810.0 * np.array([-1.0, -1.0, 0.0]), atol=1e-6)


def test_wind_on_a_flat_face_is_that_on_a_plate(face):
    """The block's skin is flat and looks along z."""
    skin = face.model.skin.vertices
    area = np.ptp(skin[:, 0]) * np.ptp(skin[:, 1])
    plate = 0.5 * AIR * DRAG * area * 9000.0**2
    inward = Wind(face, (0.0, 0.0, -9.0))
    total = inward.at(motion(face), 0.0).sum(axis=0)
    np.testing.assert_allclose(total, [0.0, 0.0, -plate], atol=1e-6 * plate)
    away = inward.at(motion(face, v=(0.0, 0.0, -9000.0)), 0.0)
    np.testing.assert_allclose(away, 0.0, atol=1e-6)
    aslant = Wind(face, (9.0, 0.0, -9.0)).at(motion(face), 0.0).sum(axis=0)
    np.testing.assert_allclose(aslant, total, atol=1e-6 * plate)
    behind = Wind(face, (0.0, 0.0, 9.0)).at(motion(face), 0.0).sum(axis=0)
    np.testing.assert_allclose(behind, -total, atol=1e-6 * plate)
    turned = Wind(face, (9.0, 0.0, 0.0)).at(motion(face, TURNED), 0.0)
    assert np.abs(turned).max() < 1e-6 * plate


def test_a_triangle_without_area_takes_no_wind(face):
    model = face.model
    corner = model.skin.faces[0, 0]
    flat = np.vstack([[corner, corner, model.skin.faces[0, 1]], model.skin.faces])
    pinched = Face(replace(model, skin=Surface(model.skin.vertices, flat)))
    forces = [Wind(each, (0.0, 0.0, -9.0)).at(motion(face), 0.0) for each in (face, pinched)]
    np.testing.assert_array_equal(*forces)


def test_gusts_come_and_go_the_same_for_a_seed(face):
    times = np.linspace(0.0, 20.0, 400)
    wind = Wind(face, (10.0, 0.0, 0.0), gusts=0.3, seed=1)
    speeds = np.array([wind.velocity(time)[0] for time in times])
    assert 7000.0 <= speeds.min() < 8500.0 < 11500.0 < speeds.max() <= 13000.0
    again = Wind(face, (10.0, 0.0, 0.0), gusts=0.3, seed=1)
    other = Wind(face, (10.0, 0.0, 0.0), gusts=0.3, seed=2)
    assert again.velocity(3.0)[0] == wind.velocity(3.0)[0] != other.velocity(3.0)[0]


def test_a_pull_is_spread_near_its_point_turns_with_the_head_and_grows(face):
    vertex = 20
    pull = Pull(face.model, vertex, (0.0, 50.0, 0.0), radius_mm=30.0, ramp=2.0)
    forces = pull.at(motion(face, TURNED), 1.0)
    np.testing.assert_allclose(forces.sum(axis=0), [-25e3, 0.0, 0.0], atol=1e-6)
    pulled = np.flatnonzero(np.abs(forces).sum(axis=1))
    far = np.linalg.norm(face.model.rest[pulled] - face.model.skin.vertices[vertex], axis=1)
    assert len(pulled) > 1
    assert far.max() < 30.0
    assert not pull.at(motion(face), 0.0).any()
    with pytest.raises(InputError) as caught:
        Pull(face.model, 10**6, (0.0, 1.0, 0.0))
    assert caught.value.code == "force.point"
