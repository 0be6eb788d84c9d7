"""The body in MuJoCo, torques of joints, and time steps."""

import builtins

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.neck.body import DOFS, Body
from solver.neck.builtin import builtin_neck
from solver.neck.dynamics import Dynamics

NECK = builtin_neck()
RANDOM = np.random.default_rng(2)
TURNS = NECK.ranges * RANDOM.uniform(-1.3, 1.3, (8, 3))
V = RANDOM.standard_normal(DOFS)
STEP = 1e-6


def moved(dof: int, by: float) -> np.ndarray:
    more = np.zeros((8, 3))
    more[dof // 3, dof % 3] = by
    return (Rotation.from_rotvec(TURNS) * Rotation.from_rotvec(more)).as_rotvec()


def difference(value, dof: int):
    return (value(moved(dof, STEP)) - value(moved(dof, -STEP))) / (2.0 * STEP)


def test_lengths_and_moment_arms_are_those_of_the_pose():
    body = Body(NECK)
    body.set_pose(TURNS)
    pose = NECK.pose(TURNS)
    for muscle, length in zip(NECK.muscles, body.lengths, strict=True):
        path = pose.points(muscle.bodies, muscle.points)
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(length * 1e3)
    np.testing.assert_allclose(body.head, pose.head, atol=1e-9)
    arms = body.arms.copy()

    def lengths(turns):
        body.set_pose(turns)
        return body.lengths.copy()

    exact = np.array([difference(lengths, dof) for dof in range(DOFS)]).T
    assert np.abs(exact).max() > 0.01
    np.testing.assert_allclose(arms, exact, atol=1e-7)


def test_the_heads_velocity_and_drift_are_those_of_its_rotation():
    body = Body(NECK)

    def at(time):
        turned = Rotation.from_rotvec(TURNS) * Rotation.from_rotvec(V.reshape(8, 3) * time)
        body.set_pose(turned.as_rotvec(), V)
        return Rotation.from_matrix(body.head), body.head_jacobian() @ V

    before = at(-STEP)
    after = at(STEP)
    omega = (after[0] * before[0].inv()).as_rotvec() / (2.0 * STEP)
    np.testing.assert_allclose(at(0.0)[1], omega, atol=1e-6)
    drift = (after[1] - before[1]) / (2.0 * STEP)
    assert np.abs(drift).max() > 0.1
    np.testing.assert_allclose(body.head_drift(), drift, atol=1e-5)


def test_torques_of_joints_are_the_slope_of_their_energy():
    dynamics = Dynamics(NECK)
    assert (np.linalg.norm(TURNS / NECK.ranges, axis=1) > 1.0).any()  # ligaments pull

    def energy(turns):
        dynamics.body.set_pose(turns)
        return dynamics.joint_energy()

    exact = -np.array([difference(energy, dof) for dof in range(DOFS)])
    dynamics.body.set_pose(TURNS)
    assert np.abs(exact).max() > 0.5
    np.testing.assert_allclose(dynamics.passive_torque() + dynamics.body.bias, exact, atol=1e-6)


def test_a_push_is_the_work_it_does():
    body = Body(NECK)
    force = np.array([30.0, -4.0, 7.0])
    point = np.array([5.0, 64.0, 105.0])

    def work(turns):
        at = NECK.pose(turns).points(np.array([8]), point[None])[0]
        return float(force @ at) * 1e-3

    exact = np.array([difference(work, dof) for dof in range(DOFS)])
    body.set_pose(TURNS)
    assert np.abs(exact).max() > 1.0
    np.testing.assert_allclose(body.push(force, point), exact, atol=1e-5)


def test_without_mujoco_the_extra_is_named(monkeypatch):
    real = builtins.__import__

    def missing(name, *args, **kwargs):
        if name == "mujoco":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(InputError, match=r"myoface\[neck\]") as caught:
        Body(NECK)
    assert caught.value.code == "neck.extra"
