"""Flesh in motion against known answers: equilibria, momentum, moving heads, things in the way."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp

from solver.errors import InputError, SolveError
from solver.fitting.face import Face
from solver.mechanics.flesh import COROTATED_TRACE
from solver.similarity import IDENTITY, Similarity, small_motion
from solver.simulation import Simulator
from solver.simulation.forces import Drive, FleshMotion, Gravity, Inertia, lumped_masses
from tests.solver.block import block_model, poses

PASCAL = 3000.0
EXACT = {"tolerance": 1e-9, "settled_mm": 0.0, "linear": "superlu"}


def face_of(model=None, pascal=PASCAL):
    return Face(model or block_model(), material=COROTATED_TRACE.in_pascal(pascal))


def simulator(face, potentials=(), forces=(), *, dynamic=False, **options):
    density = np.full(len(face.model.tets), 1e-3)
    options = EXACT | {"damping": 0.0} | options
    return Simulator(face, potentials, forces, dynamic=dynamic, density=density, **options)


def masses_of(face):
    return lumped_masses(face.flesh, np.full(len(face.model.tets), 1e-3))


def energy(face, motion):
    """Return the kinetic and elastic energy of passive flesh."""
    kinetic = 0.5 * float(masses_of(face) @ (motion.v**2).sum(axis=1))
    return kinetic + face.flesh.energy(motion.x, face.flesh.passive())


def drive(face, pose, time=0.0, head=IDENTITY, objects=()):
    A = face.flesh_controls(pose.a)
    return Drive(time, A, pose.b, head, objects)


def test_derivatives_of_inertia_damping_and_work_match_differences():
    face = face_of(pascal=50.0)
    inertia = Inertia(face.flesh)
    rng = np.random.default_rng(6)
    flesh = face.flesh.plus(inertia)
    y, flight = (flesh.rest + rng.standard_normal(flesh.rest.shape) for _ in range(2))
    inertia.launch(masses_of(face), y, flight, 0.02, 5.0)
    inertia.load = 100.0 * rng.standard_normal(flesh.rest.shape)
    x = flesh.rest + 0.2 * rng.standard_normal(flesh.rest.shape)
    a = flesh.passive()
    step = rng.standard_normal(flesh.size)
    ends = [flesh.add_motion(x, sign * 1e-6 * step) for sign in (1, -1)]
    slope = (flesh.energy(ends[0], a) - flesh.energy(ends[1], a)) / 2e-6
    passive = face.flesh.gradient(x, a) @ step
    assert abs(slope - passive) > 0.1 * abs(slope)
    assert flesh.gradient(x, a) @ step == pytest.approx(slope, rel=1e-5)
    change = (flesh.gradient(ends[0], a) - flesh.gradient(ends[1], a)) / 2e-6
    curvature = flesh.hessian(x, a) @ step
    np.testing.assert_allclose(curvature, change, atol=1e-5 * np.abs(change).max())
    assert np.abs(curvature - face.flesh.hessian(x, a) @ step).max() > 0.01 * np.abs(change).max()


def test_quasi_static_steps_end_in_the_equilibria_of_a_fit():
    face = face_of()
    pose = poses(1)[0]
    steps = simulator(face)
    neutral = drive(face, face.rest_pose())
    motion = steps.rest(neutral)
    np.testing.assert_allclose(motion.x, face.model.rest, atol=1e-6)
    stepped = steps.step(motion, neutral, drive(face, pose, 1.0))
    settled = face.continuation(face.rest, pose)
    assert np.abs(settled.x - face.model.rest).max() > 3.0
    np.testing.assert_allclose(stepped.y, settled.x, atol=1e-5)
    assert stepped.inverted == stepped.halvings == 0
    assert not stepped.motion.v.any()


@pytest.fixture(scope="module")
def blob():
    """Flesh that nothing holds, stretched and flying."""
    none = np.zeros(0, int)
    face = face_of(replace(block_model(), cranium=none, mandible=none))
    rest = face.model.rest
    spin = np.cross([0.0, 0.0, 4.0], rest - rest.mean(axis=0))
    v = spin + 50.0 * np.sin(rest / 9.0) + [300.0, -40.0, 25.0]
    return face, FleshMotion(rest * [1.1, 0.95, 1.0], v, IDENTITY)


def test_free_flesh_keeps_its_momentum_and_loses_energy_only(blob):
    face, motion = blob
    steps = simulator(face, dynamic=True, tolerance=1e-11)
    masses = masses_of(face)
    momentum = masses @ motion.v
    moment = drive(face, face.rest_pose())

    energies = [energy(face, motion)]
    for _ in range(20):
        goal = replace(moment, time=moment.time + 0.01)
        motion = steps.step(motion, moment, goal).motion
        moment = goal
        energies.append(energy(face, motion))
    lost = np.abs(masses @ motion.v - momentum).max() / np.linalg.norm(momentum)
    assert lost < 1e-9
    assert (np.diff(energies) < 1e-9 * energies[0]).all()
    drifting = 0.5 * float(momentum @ momentum) / masses.sum()
    assert drifting < energies[-1] < 0.9 * energies[0]


def test_short_steps_lose_little_energy(blob):
    """Backward Euler is of first order: a step of a tenth the length loses a hundredth."""
    face, start = blob
    lost = []
    for seconds in (1e-3, 1e-4):
        steps = simulator(face, dynamic=True)
        motion = start
        before = drive(face, face.rest_pose())
        for _ in range(3):
            goal = replace(before, time=before.time + seconds)
            motion = steps.step(motion, before, goal).motion
            before = goal
        lost.append(1.0 - energy(face, motion) / energy(face, start))
    assert 0.0 < lost[1] < 0.03 * lost[0]


def test_a_moving_head_needs_no_fictitious_forces():
    """Flesh in a head that accelerates steadily hangs as if gravity pulled the other way."""
    face = face_of()
    acceleration = np.array([12000.0, -6000.0, 18000.0])
    neutral = drive(face, face.rest_pose())
    moving = simulator(face, dynamic=True, damping=40.0)
    motion = moving.rest(neutral)
    before = neutral
    for number in range(1, 120):
        time = 0.02 * number
        head = Similarity(1.0, np.eye(3), 0.5 * acceleration * time**2)
        goal = replace(neutral, time=time, head=head)
        stepped = moving.step(motion, before, goal)
        motion = stepped.motion
        before = goal
    hanging = simulator(face, forces=[Gravity(masses_of(face), -acceleration, (0.0, 0.0, 0.0))])
    expected = hanging.rest(neutral).x
    assert np.abs(expected - face.model.rest).max() > 0.5
    np.testing.assert_allclose(stepped.y, expected, atol=1e-5)


def test_the_world_may_be_turned():
    """The same motion of the head, seen from a turned world, is the same motion of the flesh."""
    face = face_of()
    frames = (IDENTITY, small_motion(np.array([0.3, -1.2, 0.5, 70.0, -30.0, 10.0])))
    neutral = drive(face, face.rest_pose())
    ends = []
    for frame in frames:
        steps = simulator(face, dynamic=True)
        before = replace(neutral, head=frame)
        motion = steps.rest(before)
        for number in range(1, 6):
            nod = small_motion(np.array([0.05 * number, 0.0, 0.02 * number**2, 3.0, 0.0, number]))
            goal = replace(neutral, time=0.02 * number, head=nod.then(frame))
            stepped = steps.step(motion, before, goal)
            motion = stepped.motion
            before = goal
        ends.append(stepped.y)
    assert np.abs(ends[0] - face.model.rest).max() > 0.2
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6)


def test_dynamic_motion_comes_to_rest_where_the_quasi_static_one_is():
    face = face_of(pascal=200.0)
    neutral = drive(face, face.rest_pose())
    goal = drive(face, poses(1)[0])
    ends = []
    for dynamic in (False, True):
        steps = simulator(face, dynamic=dynamic, damping=2.0)
        motion = steps.rest(neutral)
        before = neutral
        for number in range(1, 31):
            here = replace(neutral.toward(goal, min(number / 10, 1.0)), time=number / 30)
            stepped = steps.step(motion, before, here)
            motion = stepped.motion
            before = here
            if number == 10:
                ends.append(stepped.y)
    quasi_static, moving = ends
    assert np.abs(moving - quasi_static).max() > 0.01
    assert np.abs(stepped.y - quasi_static).max() < 1e-3
    assert np.abs(motion.v).max() < 0.1


class Lid:
    """A frictionless barrier below a plane whose height (z) is that of the first object."""

    REACH = 0.5
    STIFFNESS = 2e4

    def begin(self, x, now, seconds):
        pass

    def place(self, boundary):
        self.height = boundary.objects[0][0, 2]

    def gap(self, x):
        return (self.height - x[:, 2]) / self.REACH

    def value(self, x):
        gap = self.gap(x)
        if gap.min() <= 0.0:
            return np.inf
        near = gap[gap < 1.0]
        return float(-self.STIFFNESS * ((near - 1.0) ** 2 * np.log(near)).sum())

    def gradient(self, x):
        gap = np.minimum(self.gap(x), 1.0)
        slope = -self.STIFFNESS * (2.0 * (gap - 1.0) * np.log(gap) + (gap - 1.0) ** 2 / gap)
        return np.outer(-slope / self.REACH, [0.0, 0.0, 1.0])

    def hessian(self, x):
        gap = np.minimum(self.gap(x), 1.0)
        bend = -2.0 * np.log(gap) - 4.0 * (gap - 1.0) / gap + ((gap - 1.0) / gap) ** 2
        bend *= self.STIFFNESS / self.REACH**2
        places = 3 * np.flatnonzero(bend) + 2
        return sp.csr_array((bend[bend > 0.0], (places, places)), shape=(x.size, x.size))

    def pull(self, x, goal):
        down = np.zeros(x.size)
        down[2::3] = goal.objects[0][0, 2] - self.height
        return -(self.hessian(x) @ down).reshape(-1, 3)

    def max_step(self, x, y, goal):
        before = self.height - x[:, 2]
        after = goal.objects[0][0, 2] - y[:, 2]
        crossing = after <= 0.0
        parts = before[crossing] / (before - after)[crossing]
        return float(parts.min()) if crossing.any() else 1.0


def lid(height):
    return (np.array([[0.0, 0.0, height]]),)


def test_flesh_gives_way_to_what_is_pushed_into_it_and_nothing_crosses():
    face = face_of()
    top = face.model.rest[:, 2].max()
    steps = simulator(face, [Lid()])
    before = drive(face, face.rest_pose(), objects=lid(top + 2.0))
    motion = steps.rest(before)
    goal = replace(before, time=1.0, objects=lid(top - 4.0))
    stepped = steps.step(motion, before, goal)
    heights = stepped.y[:, 2]
    assert top - 4.0 - Lid.REACH < heights.max() < top - 4.0
    assert (heights > top - 4.0 - Lid.REACH).sum() >= 20
    assert stepped.inverted == 0
    back = steps.step(stepped.motion, goal, replace(before, time=2.0))
    np.testing.assert_allclose(back.y, face.model.rest, atol=1e-5)


@pytest.mark.parametrize("time", [0.0, -0.1, np.nan])
def test_time_goes_on(time):
    face = face_of()
    steps = simulator(face, dynamic=True)
    before = drive(face, face.rest_pose())
    motion = steps.rest(before)
    with pytest.raises(InputError) as caught:
        steps.step(motion, before, replace(before, time=time))
    assert caught.value.code == "scene.times"


class Hurdle(Lid):
    """A lid, far away, that no step of more than a quarter of a second begins under."""

    def begin(self, x, now, seconds):
        if seconds > 0.26:
            raise SolveError("simulate.jammed", "too fast")


def test_a_step_is_halved_as_often_as_need_be_and_ends_where_short_ones_do():
    face = face_of()
    before = drive(face, face.rest_pose(), objects=lid(200.0))
    nod = small_motion(np.array([0.4, 0.0, 0.2, 5.0, 0.0, 1.0]))
    goal = drive(face, poses(1)[0], 1.0, nod, lid(200.0))
    steps = simulator(face, [Hurdle()], dynamic=True)
    start = steps.rest(before)
    halved = steps.step(start, before, goal)
    # once from one second to a quarter, and once when half a second was tried again
    assert halved.halvings == 3
    motion = start
    here = before
    for part in (0.25, 0.5, 0.75, 1.0):
        target = before.toward(goal, part)
        motion = steps.step(motion, here, target).motion
        here = target
    assert np.abs(halved.motion.v).max() > 1.0
    np.testing.assert_allclose(halved.motion.x, motion.x, atol=1e-5)
    np.testing.assert_allclose(halved.motion.v, motion.v, atol=1e-3)


@pytest.mark.long
def test_what_can_not_be_reached_fails_with_its_time():
    face = face_of()
    steps = simulator(face, [Lid()])
    before = drive(face, face.rest_pose(), objects=lid(20.0))
    motion = steps.rest(before)
    with pytest.raises(SolveError) as caught:
        steps.step(motion, before, replace(before, time=1.0, objects=lid(-5.0)))
    assert caught.value.code == "simulate.jammed"
    assert 0.5 < caught.value.context["time"] < 1.0


def test_a_force_that_is_no_number_is_no_rest():
    class Broken:
        def at(self, motion, _time, /):
            return np.full_like(motion.x, np.nan)

    face = face_of()
    steps = simulator(face, forces=[Broken()])
    with pytest.raises(SolveError) as caught:
        steps.rest(drive(face, face.rest_pose(), time=2.5))
    assert caught.value.code == "simulate.diverged"
    assert caught.value.context["time"] == 2.5


class Crusher(Lid):
    """A lid so hard, where it goes far in one step, that no factorisation bears it."""

    FAR_MM = 2.0

    def begin(self, x, now, seconds):
        self.place(now)
        self.begun = self.height

    def hessian(self, x):
        matrix = super().hessian(x)
        return matrix if self.begun - self.height < self.FAR_MM else -1e9 * matrix


def test_a_step_too_hard_to_factorise_is_halved():
    face = face_of()
    top = face.model.rest[:, 2].max()
    steps = simulator(face, [Crusher()])
    before = drive(face, face.rest_pose(), objects=lid(top + 2.0))
    goal = replace(before, time=1.0, objects=lid(top - 4.0))
    stepped = steps.step(steps.rest(before), before, goal)
    assert stepped.halvings > 0
    assert stepped.y[:, 2].max() < top - 4.0
