"""The voluntary layer: 25 times a second, activations that take the head where it should be.

It asks for an angular acceleration of the head, by how far the head and its velocity will be off at
the middle of the tick, T/2 ahead,

    alpha = (alpha_g + 2 z w (omega_g - omega) + w^2 rot(R_g R^T)) / (1 + z w T + w^2 T^2/8),

where the denominator counts what alpha itself does until then. Joints cannot be commanded one by
one, as muscles leave some torques out of reach; they are asked softly for what brings them to the
pose that shares out the head's rotation. With A the inertia plus what discs and muscles resist over
half a tick (not ligaments, which stop a joint within a tenth of it), L = dl/dq,
F and P of :mod:`solver.neck.hill` and tau all torques but the active ones,

    q'' = A^-1 (tau - L^T F a)
    min w_h |J q'' + J' v - alpha|^2 + w_j |A q*'' - tau + L^T F a|^2 + w_a |a - c|^2

over the mean activations a of the tick that the lag of muscles can reach from where they are:
e a_0 <= a <= 1 - e' (1 - a_0), e = tau/T (1 - exp(-T/tau)). The excitation that has this mean is
the answer; q'' is also the plan that the reflexes keep. c is co-contraction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import SolveError
from solver.mechanics.bounded import solve_bounded
from solver.neck.anatomy import JOINTS
from solver.neck.dynamics import Dynamics
from solver.neck.posture import share_out
from solver.surface import Floats

Goal = Callable[[float], Rotation]  # the head's rotation at a time in s


@dataclass(frozen=True)
class VoluntaryOptions:
    """Rate, stiffness of the goals and weights of the least squares."""

    rate_hz: float = 25.0
    head_hz: float = 3.0  # w / 2 pi
    head_damping: float = 1.0  # z
    joint_hz: float = 1.5  # the same of the joints' goals
    joint_damping: float = 1.0
    head_weight: float = 0.02  # w_h, of (rad/s^2)^2
    joint_weight: float = 3.0  # w_j, of (N m)^2
    activation_weight: float = 0.3  # w_a
    cocontraction: float = 0.0  # c, the activation that costs nothing
    most_rad_per_s2: float = 80.0  # that is asked of the head or a joint beside the goal's own
    share_rounds: int = 4  # of sharing out the goal among the joints
    difference_s: float = 0.01  # to either side, for the goal's velocity and acceleration


class Voluntary:
    """The layer, with what it remembers from tick to tick: who was at a bound."""

    def __init__(self, options: VoluntaryOptions = VoluntaryOptions()) -> None:
        self.options = options
        self._sides: np.ndarray | None = None

    def plan(self, dynamics: Dynamics, goal: Goal, time_s: float) -> None:
        """Put the plan of the tick that begins into ``dynamics``.

        Raises :class:`SolveError`: ``neck.voluntary`` if the least squares do not end.
        """
        o = self.options
        body = dynamics.body
        tick = 1.0 / o.rate_hz
        half = tick / 2.0
        arms = body.arms
        lengths = body.lengths
        v = body.v.copy()
        rates = arms @ v
        parts = dynamics.muscles.parts(lengths, rates)
        a_0 = dynamics.activations
        F = parts[:, 0]
        P = parts[:, 3]
        slows = a_0 * parts[:, 2] + parts[:, 5]
        stiffens = np.maximum(a_0 * parts[:, 1] + parts[:, 4], 0.0)
        D = np.diag(dynamics.damping) + arms.T @ (slows[:, None] * arms)
        K = np.diag(dynamics.stiffness) + arms.T @ (stiffens[:, None] * arms)
        A = body.inertia + half * D + half**2 / 2.0 * K
        tau = dynamics.passive_torque() - arms.T @ P - half * (K @ v)
        pull = arms.T * F
        head, joints = self._asked(dynamics, goal, time_s + half, half)
        J = body.head_jacobian()
        to_head = np.linalg.solve(A, J.T).T
        wanted = [
            np.sqrt(o.head_weight) * (to_head @ tau + body.head_drift() - head),
            np.sqrt(o.joint_weight) * (tau - A @ joints),
        ]
        rows = [np.sqrt(o.head_weight) * to_head @ pull, np.sqrt(o.joint_weight) * pull]
        left = np.vstack(rows)
        right = np.concatenate(wanted)
        H = left.T @ left + o.activation_weight * np.eye(len(F))
        g = left.T @ right + o.activation_weight * o.cocontraction
        a = self._solve(H, g, *self._bounds(dynamics, tick))
        acceleration = np.linalg.solve(A, tau - pull @ a)
        plan = dynamics.plan
        plan[:, 0] = self._excitation(dynamics, a, tick)
        plan[:, 1] = lengths
        plan[:, 2] = rates
        plan[:, 3] = arms @ acceleration
        dynamics.since = 0.0

    def _asked(
        self, dynamics: Dynamics, goal: Goal, time_s: float, half: float
    ) -> tuple[Floats, Floats]:
        """Return the head's angular acceleration (3,) and the joints' (24,) that are asked for."""
        o = self.options
        body = dynamics.body
        d = self.options.difference_s
        goals = [goal(time_s + sign * d) for sign in (-1.0, 0.0, 1.0)]
        first, last = ((b * a.inv()).as_rotvec() / d for a, b in pairwise(goals))
        J = body.head_jacobian()
        v = body.v
        omega = J @ v
        now = Rotation.from_rotvec(omega * half) * Rotation.from_matrix(body.head)
        off = (goals[1] * now.inv()).as_rotvec()
        slower = (first + last) / 2.0 - omega
        onward = (last - first) / d
        head = self._servo(off, slower, onward, half, o.head_hz, o.head_damping)
        poses = [
            Rotation.from_rotvec(share_out(dynamics.neck, each.as_matrix(), o.share_rounds).turns)
            for each in goals
        ]
        first, last = ((a.inv() * b).as_rotvec() / d for a, b in pairwise(poses))
        own = v.reshape(JOINTS, 3)
        now = Rotation.from_rotvec(body.turns) * Rotation.from_rotvec(own * half)
        off = (now.inv() * poses[1]).as_rotvec()
        slower = (first + last) / 2.0 - own
        onward = (last - first) / d
        joints = self._servo(off, slower, onward, half, o.joint_hz, o.joint_damping)
        return head, joints.ravel()

    def _servo(
        self, off: Floats, slower: Floats, onward: Floats, half: float, hz: float, damping: float
    ) -> Floats:
        """Return the acceleration for being ``off`` and ``slower`` at the middle of a tick."""
        w = 2.0 * np.pi * hz
        most = self.options.most_rad_per_s2
        counted = 1.0 + 2.0 * damping * w * half + w**2 * half**2 / 2.0
        back = (2.0 * damping * w * slower + w**2 * off) / counted
        length = np.linalg.norm(back, axis=-1, keepdims=True)
        return np.asarray(
            onward / counted + back * np.minimum(1.0, most / np.maximum(length, most))
        )

    def _bounds(self, dynamics: Dynamics, tick: float) -> tuple[Floats, Floats]:
        a = dynamics.activations
        reflex = dynamics.reflex
        low = a * _kept(reflex.fall_s, tick)
        return low, 1.0 - (1.0 - a) * _kept(reflex.rise_s, tick)

    def _excitation(self, dynamics: Dynamics, mean: Floats, tick: float) -> Floats:
        """Return the excitations whose activations have these means over the tick."""
        a = dynamics.activations
        reflex = dynamics.reflex
        kept = np.where(mean > a, _kept(reflex.rise_s, tick), _kept(reflex.fall_s, tick))
        return np.asarray(((mean - a * kept) / (1.0 - kept)).clip(0.0, 1.0))

    def _solve(self, H: Floats, g: Floats, low: Floats, high: Floats) -> Floats:
        if self._sides is None:
            self._sides = np.zeros(len(g), np.int8)
        x = np.empty(len(g))
        if not solve_bounded(H, g, low, high, self._sides, x):
            raise SolveError("neck.voluntary", "the least squares of the muscles did not end")
        return x


def _kept(lag: float, tick: float) -> float:
    """Return how much of the activation at the start is in the tick's mean."""
    return float(lag / tick * -np.expm1(-tick / lag))
