"""The motion of a neck: M(q) q'' + C(q, v) + discs + muscles = forces from outside.

Discs push back by theta, each joint's rotation vector: their energy is theta . K theta / 2, and
that of ligaments k x^3 / 3d at x = |theta| (1 - 1/rho) beyond where they are slack, an ellipsoid
|theta/r| = rho < 1 with a part of the joint's ranges as half axes, d = 0.1 rad; their torque is
-J^-T dE/dtheta - D v, J the right Jacobian of the rotation. A muscle pulls by -dl/dq f.

A step is semi-implicit: what damps, discs and muscles that are stretched fast, acts at the new
velocity, for vertebrae are so light that their discs stop them within 1/20 ms, and ligaments, of
stiffness S = 2 k x / d, at the new place:

    (M + h D + h L^T (df/dv) L + h^2 S) (v' - v) = h (tau(q, v) - h S v),   q' = q exp(h v'),

L = dl/dq.

v is thus that of half a step before q (a leapfrog), and C is taken at v + (v' - v)/2, by the last
step's: without damping the energy stays, to second order.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from solver.errors import SolveError
from solver.mechanics.cholesky import solve_lower
from solver.neck.anatomy import JOINTS, Neck
from solver.neck.body import DOFS, Body
from solver.neck.hill import HillOptions, Muscles, all_parts
from solver.neck.reflex import ReflexOptions, excite
from solver.surface import Floats, Ints

FASTEST = 1e4  # rad/s, of a joint; a faster one has blown up
TOE = 0.1  # rad beyond their slack at which ligaments have the stiffness of Neck.ligaments
NARROWEST = 0.02  # rad, of a joint's half axes: what turns by less is held by its disc


class Dynamics:
    """A neck in motion: its body, activations (m,) and the plan that reflexes keep."""

    def __init__(
        self,
        neck: Neck,
        reflex: ReflexOptions | None = None,
        hill: HillOptions | None = None,
        gravity: Floats | None = None,
    ) -> None:
        reflex = reflex or ReflexOptions()
        self.neck = neck
        self.reflex = reflex
        self.body = Body(neck, gravity)
        self.muscles = Muscles.of(neck, hill or HillOptions())
        count = len(neck.muscles)
        self.activations = np.zeros(count)
        self.stiffness = neck.stiffness.ravel()
        self.damping = neck.damping.ravel()
        self.slack = np.maximum(neck.slack * neck.ranges, NARROWEST).ravel()
        self.ligaments = neck.ligaments
        self.external = np.zeros(DOFS)  # torques (24,) from outside, N m
        self.plan = np.zeros((count, 5))  # u_0, l_0, l_1, l_2, l_r: see reflex.excite
        self.plan[:, 1] = self.plan[:, 4] = self.body.lengths
        self.since = 0.0  # the plan was made, s
        self._late = np.zeros((reflex.delay_steps + 1, count))
        self._place = 0

    def passive_torque(self) -> Floats:
        """Return what discs, weight and motion do at the joints (24,), without muscles, in N m."""
        springs = np.empty(DOFS)
        joints = self.stiffness, self.slack, self.ligaments
        joint_torques(self.body.q, *joints, springs, np.empty(JOINTS))
        return np.asarray(springs - self.damping * self.body.v - self.body.bias)

    def joint_energy(self) -> float:
        """Return the energy in discs and ligaments in J."""
        strained = self.ligaments * (self._beyond() ** 3).sum() / (3.0 * TOE)
        return float(self.stiffness @ self.body.turns.ravel() ** 2 / 2.0 + strained)

    def _beyond(self) -> Floats:
        """Return how far joints (8,) are beyond where their ligaments are slack, rad."""
        turns = self.body.turns
        reach = np.linalg.norm(turns / self.slack.reshape(turns.shape), axis=1)
        return np.asarray(np.linalg.norm(turns, axis=1) * (1.0 - 1.0 / np.maximum(reach, 1.0)))

    def advance(self, steps: int) -> None:
        """Let time pass; the body is up to date before and after.

        Raises :class:`SolveError` (``neck.unstable``) if the motion has blown up.
        """
        body = self.body
        reflex = self.reflex
        model = body.model
        data = body.data
        lags = (reflex.rise_s, reflex.fall_s)
        gains = reflex.gains
        step = reflex.step_s
        change = np.zeros(DOFS)
        for _ in range(steps):
            _step(
                step,
                (body.q, body.v, self.activations, change),
                (body.inertia, data.qfrc_bias, self.damping, self.external),
                (self.stiffness, self.slack, self.ligaments),
                (model.ten_J_rownnz, model.ten_J_rowadr, model.ten_J_colind, data.ten_J),
                (data.ten_length, self.muscles.law, self.muscles.table),
                (self.plan, self.since, self._late, self._place, gains, lags),
            )
            self.since += step
            self._place = (self._place + 1) % len(self._late)
            body.update(change / 2.0)
        if not np.abs(body.v).max() < FASTEST:
            message = "the motion of the neck blew up: discs are too stiff for the time step"
            raise SolveError("neck.unstable", message)


@nb.njit(cache=True, error_model="numpy")
def joint_torques(
    q: Floats, stiffness: Floats, slack: Floats, ligaments: float, made: Floats, stops: Floats
) -> None:
    """Write what discs and ligaments do.

    The torques ``made`` (24,) are in the axes of the bodies above; ``stops`` (8,) are the stiffness
    of each joint's ligaments in N m/rad.
    """
    for k in range(len(q) // 4):
        w = q[4 * k]
        x = q[4 * k + 1]
        y = q[4 * k + 2]
        z = q[4 * k + 3]
        if w < 0.0:
            w = -w
            x = -x
            y = -y
            z = -z
        s = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(s, w)
        scale = angle / s if s > 1e-9 else 2.0
        x = scale * x
        y = scale * y
        z = scale * z
        if angle > 1e-3:
            c = (1.0 - angle * math.cos(angle / 2.0) / (2.0 * math.sin(angle / 2.0))) / angle**2
        else:
            c = 1.0 / 12.0
        reach = 0.0  # the square of rho
        for i, turn in ((3 * k, x), (3 * k + 1, y), (3 * k + 2, z)):
            made[i] = stiffness[i] * turn
            reach += (turn / slack[i]) ** 2
        stops[k] = 0.0
        if reach > 1.0:
            inside = angle / math.sqrt(reach)
            beyond = angle - inside
            stops[k] = 2.0 * ligaments / TOE * beyond
            pull = ligaments / TOE * beyond * beyond / angle
            for i, turn in ((3 * k, x), (3 * k + 1, y), (3 * k + 2, z)):
                made[i] += pull * turn * (1.0 + inside / angle * ((inside / slack[i]) ** 2 - 1.0))
        a = made[3 * k]
        b = made[3 * k + 1]
        d = made[3 * k + 2]
        # theta x K theta
        e = y * d - z * b
        f = z * a - x * d
        g = x * b - y * a
        made[3 * k] = -(a - 0.5 * e + c * (y * g - z * f))
        made[3 * k + 1] = -(b - 0.5 * f + c * (z * e - x * g))
        made[3 * k + 2] = -(d - 0.5 * g + c * (x * f - y * e))


@nb.njit(cache=True, error_model="numpy")
def _step(
    h: float,
    state: tuple[Floats, Floats, Floats, Floats],
    body: tuple[Floats, Floats, Floats, Floats],
    joints: tuple[Floats, Floats, float],
    arms: tuple[Ints, Ints, Ints, Floats],
    pulls: tuple[Floats, int, Floats],
    control: tuple,
) -> None:
    q, v, a, change = state
    inertia, bias, damping, external = body
    counts, firsts, columns, values = arms
    lengths, law, table = pulls
    plan, since, late, place, gains, lags = control
    dofs = len(v)
    muscles = len(a)
    rates = np.zeros(muscles)
    parts = np.empty((muscles, 6))
    for k in range(muscles):
        for j in range(firsts[k], firsts[k] + counts[k]):
            rates[k] += values[j] * v[columns[j]]
    excite(plan, since, lengths, rates, late, place, gains, lags, h, a)
    all_parts(law, table, lengths, rates, parts)
    torque = np.empty(dofs)
    stops = np.empty(dofs // 3)
    joint_torques(q, joints[0], joints[1], joints[2], torque, stops)
    A = inertia.copy()
    for i in range(dofs):
        stop = h * stops[i // 3]
        torque[i] += external[i] - (damping[i] + stop) * v[i] - bias[i]
        A[i, i] += h * (damping[i] + stop)
    for k in range(muscles):
        force = a[k] * parts[k, 0] + parts[k, 3]
        slows = h * (a[k] * parts[k, 2] + parts[k, 5])
        for j in range(firsts[k], firsts[k] + counts[k]):
            torque[columns[j]] -= values[j] * force
            for i in range(firsts[k], j + 1):
                A[columns[j], columns[i]] += slows * values[j] * values[i]
    solve_lower(A, torque)
    for i in range(dofs):
        change[i] = h * torque[i]
        v[i] += change[i]
    for k in range(dofs // 3):
        _turn(q[4 * k : 4 * k + 4], v[3 * k : 3 * k + 3], h)


@nb.njit(cache=True, error_model="numpy")
def _turn(q: Floats, v: Floats, h: float) -> None:
    """Turn a quaternion on by an angular velocity in the axes that it turns."""
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    half = 0.5 * h * speed
    s = math.sin(half) / speed if speed > 1e-12 else 0.5 * h
    c = math.cos(half)
    x = s * v[0]
    y = s * v[1]
    z = s * v[2]
    w = q[0]
    i = q[1]
    j = q[2]
    k = q[3]
    a = w * c - i * x - j * y - k * z
    b = w * x + i * c + j * z - k * y
    d = w * y - i * z + j * c + k * x
    e = w * z + i * y - j * x + k * c
    length = math.sqrt(a * a + b * b + d * d + e * e)
    q[0] = a / length
    q[1] = b / length
    q[2] = d / length
    q[3] = e / length
