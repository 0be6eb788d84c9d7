"""Drives of muscles: what fits count on, of every one."""

import json

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.calibration import fibre_muscles
from solver.fitting.drives.admissible import Admissible
from solver.fitting.drives.fibre_contraction import FibreContraction
from solver.fitting.drives.fibre_muscles import FibreDrive
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.drives.stored import are_same, restore, store
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from tests.solver.simulation.test_fibres import fibred_block

DRIVES = {
    "free": lambda _: SixNumbers(),
    "admissible": lambda _: Admissible(),
    "contraction": lambda face: FibreContraction(face.model),
    "fibres": lambda face: FibreDrive(fibre_muscles(face)),
}


@pytest.fixture(scope="module", params=DRIVES)
def driven(request):
    face = Face(fibred_block(), tolerance=1e-10)
    return face.driven_by(DRIVES[request.param](face))


def pulled(face):
    """Return a pose within the bounds, with muscles that pull and an open jaw."""
    layout = face.layout
    rng = np.random.default_rng(6)
    some = 0.15 * np.abs(rng.standard_normal(layout.drive.rest.shape))
    # towards where the values have room, and along the first entry of shapes
    sign = 1.0 if np.all(np.asarray(layout.drive.lower) == layout.drive.rest) else -1.0
    change = np.zeros(layout.size)
    change[layout.muscles] = sign * some.reshape(len(some), -1)
    change[layout.joint_places[0]] = 0.05
    return Pose.of(layout, layout.bounds.clip(layout.rest + change))


def test_rates_are_the_derivative_of_the_forces(driven):
    check_rates(driven)


def test_at_rest_the_flesh_is_passive(driven):
    check_rest(driven)


@pytest.mark.long
def test_values_are_found_again_from_the_skin(driven):
    check_round_trip(driven)


def test_a_file_brings_it_back(driven):
    kept = json.loads(json.dumps(store(driven.drive)))
    found = restore(kept, driven.model, driven.S)
    assert type(found) is type(driven.drive)
    assert are_same(found, driven.drive)
    pose = pulled(driven)
    np.testing.assert_array_equal(
        driven.driven_by(found).flesh_controls(pose.a), driven.flesh_controls(pose.a)
    )


@pytest.mark.parametrize(
    "kept",
    [
        {},
        [3],
        {"name": "telepathy"},
        {"name": "admissible", "limits": {"reach": 3.0}},
        {"name": "fibres", "muscles": 3, "curve": {}},
    ],
)
def test_what_no_drive_is_is_told(kept):
    model = fibred_block()
    with pytest.raises(InputError) as error:
        restore(kept, model, model.weights)
    assert error.value.code == "rig.drive"


def test_fibres_of_other_tets_are_told():
    face = Face(fibred_block())
    kept = store(FibreDrive(fibre_muscles(face)))
    kept["muscles"]["tets"][-1] = len(face.model.tets)
    with pytest.raises(InputError, match="not of the model's tets") as error:
        restore(kept, face.model, face.S)
    assert error.value.code == "rig.drive"


def check_rates(face):
    pose = pulled(face)
    rng = np.random.default_rng(3)
    step = 1e-6
    x = face.model.rest + 0.2 * rng.standard_normal(face.model.rest.shape)
    rates = face.drive.rates(face.tet_forces(pose, x))
    columns = np.zeros((face.flesh.size, pose.a.size), order="F")
    rates.fill(columns)
    for number in range(pose.a.size):
        change = np.zeros(pose.a.size)
        change[number] = 1.0
        change = change.reshape(pose.a.shape)
        ends = [
            face.flesh.gradient(x, face.flesh_controls(pose.a + sign * step * change))
            for sign in (1.0, -1.0)
        ]
        exact = (ends[0] - ends[1]).ravel() / (2.0 * step)
        assert np.abs(exact).max() > 1e-2
        np.testing.assert_allclose(columns[:, number], exact, atol=1e-5 * np.abs(exact).max())
        np.testing.assert_allclose(rates.product(change), columns[:, number], atol=1e-9)
    motion = rng.standard_normal(face.flesh.size)
    np.testing.assert_allclose(rates.adjoint(motion).ravel(), columns.T @ motion, rtol=1e-9)


def check_rest(face):
    np.testing.assert_allclose(
        face.flesh_controls(face.rest_pose().a), face.flesh.passive(), atol=1e-12
    )
    assert face.layout.bounds.contains(face.layout.rest)
    np.testing.assert_array_equal(face.layout.bounds.clip(face.layout.rest), face.layout.rest)


def check_round_trip(face):
    pose = pulled(face)
    truth = face.continuation(face.rest, pose)
    points = face.face_points(truth.x)
    data = SkinDistance(face, Target.from_points(points))
    prior = Regulariser(w_a=1e-9, w_v=0.0, w_b=1e-12, prior=face.rest_pose())
    found = activation.fit(face, data, prior, options=ActivationOptions(80, tolerance=1e-9))
    moved = np.linalg.norm(points - face.face_points(face.rest.x), axis=1).max()
    left = np.linalg.norm(face.face_points(found.state.x) - points, axis=1).max()
    assert moved > 0.3
    assert left < 0.02 * moved
    np.testing.assert_allclose(found.state.pose.a, pose.a, atol=0.03)
