"""Fibre muscles calibrated to scans: derivatives of what is calibrated, and what it gains."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.calibration import (
    CalibrationOptions,
    FibreShape,
    calibrate,
    fibre_muscles,
    fit_all,
    load_muscles,
    save_muscles,
    with_fibres,
)
from solver.fitting.face import Face, Pose
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.flesh import MOONEY_RIVLIN
from tests.solver.simulation.test_fibres import fibred_block

POSES = [(0.7, 0.2), (0.1, 0.8), (0.5, 0.5)]


@pytest.fixture(scope="module")
def plain():
    return Face(fibred_block(), material=MOONEY_RIVLIN, tolerance=1e-12)


def test_rates_match_equilibria_nearby(plain):
    shape = FibreShape(plain, 8.0)
    rng = np.random.default_rng(6)
    step = 1e-5
    rest = shape.layout.rest
    values = rest + 0.1 * rng.standard_normal(len(rest))
    values[shape.layout["fractions"]] = rest[shape.layout["fractions"]]
    face = shape.face(values)
    state = face.continuation(face.rest, Pose(np.array([0.6, 0.4]), np.zeros(5), face.layout))
    sensitivity = Sensitivity(face, state)
    rates = shape.rates(sensitivity, values)
    for block in shape.layout.blocks:
        change = np.zeros(len(values))
        change[shape.layout[block.name]] = rng.uniform(0.1, 1.0, block.rest.size)
        ends = [
            shape.face(values + sign * step * change).solve_equilibrium(state.pose, state.x).x
            for sign in (1, -1)
        ]
        numeric = (ends[0] - ends[1])[face.flesh.free].ravel() / (2 * step)
        exact = sensitivity.response.free_motion(rates, change)
        assert np.abs(numeric).max() > 0.1, block.name
        np.testing.assert_allclose(exact, numeric, atol=1e-4 * np.abs(numeric).max())
        pull = rng.standard_normal(len(exact))
        by_adjoint = sensitivity.response.free_adjoint(rates, pull) @ change
        assert by_adjoint == pytest.approx(exact @ pull, rel=1e-8)


@pytest.mark.long
def test_turned_fibres_weak_muscles_and_wrong_fractions_are_found(plain, tmp_path):
    """Scans of muscles that differ from the template's in all that is calibrated."""
    shape = FibreShape(plain)
    layout = shape.layout
    truth = shape.layout.rest.copy()
    layout.part("strengths", truth)[:] = np.log([0.4, 0.25])
    layout.part("directions", truth)[:] = [0.0, 0.0, 0.5]
    real = shape.face(truth)
    states = [
        real.continuation(real.rest, Pose(np.array(a), np.zeros(5), real.layout)) for a in POSES
    ]
    data = {
        f"pose {k}": SkinDistance(plain, Target.from_points(plain.face_points(state.x)))
        for k, state in enumerate(states)
    }

    def error(endings):
        names = [name for name in data if name in endings]
        fits = ((data[name].target, endings[name].state.x) for name in names)
        return np.mean([target.distances(plain.face_points(x)).mean() for target, x in fits])

    before = error(fit_all(with_fibres(plain, fibre_muscles(plain)), data))
    rounds = []
    options = CalibrationOptions(rounds=12)
    found = calibrate(plain, data, options, lambda number, _: rounds.append(number))
    assert rounds[:3] == [0, 1, 2]
    after = error(found.endings)
    assert before > 0.05
    assert after < 0.3 * before
    for ending in found.endings.values():
        assert (ending.state.pose.a >= 0.0).all()
        assert (ending.state.pose.a <= 1.0).all()
        assert found.face.flesh.count_inverted(ending.state.x) == 0
    assert found.muscles.fractions.min() >= 0.0
    sums = np.bincount(found.muscles.tets, found.muscles.fractions)
    assert sums.max() <= 1.0 + 1e-12
    np.testing.assert_allclose(np.linalg.norm(found.muscles.fibres, axis=1), 1.0)
    path = tmp_path / "fibre_muscles.npz"
    save_muscles(path, plain, found.muscles)
    again = load_muscles(path, plain)
    for name in ("tets", "muscles", "fractions", "fibres", "strengths"):
        np.testing.assert_allclose(getattr(again, name), getattr(found.muscles, name), rtol=1e-15)
    other = Face(replace(plain.model, muscle_names=("a", "b")), material=MOONEY_RIVLIN)
    with pytest.raises(InputError) as caught:
        load_muscles(path, other)
    assert caught.value.code == "fibres.model"
