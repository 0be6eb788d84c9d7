"""The neck as a MuJoCo model: ball joints at the joints' centres, spatial tendons as muscles.

MuJoCo has what moves: M(q), the bias c(q, v) with gravity, the muscles' lengths l(q) and their
moment arms dl/dq. Discs and muscles are ours (:mod:`solver.neck.dynamics`). A state is q, eight
quaternions (w, x, y, z) of each body against the one under it, and v (24,), each joint's angular
velocity in the axes of the body above it, in rad/s. Here lengths are metres.

MuJoCo is an extra and is imported with the first body that is made.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.neck.anatomy import JOINTS, MM, Neck, NeckPose
from solver.surface import Floats

GRAVITY = 9.80665  # m/s^2, down
DOFS = 3 * JOINTS


def import_mujoco() -> Any:
    """Return MuJoCo; raises ``neck.extra`` where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        message = "a neck with muscles needs MuJoCo: pip install 'myoface[neck]'"
        raise InputError("neck.extra", message, package="mujoco") from error
    return mujoco


class Body:
    """A neck that can be posed: its state, and what MuJoCo says of it.

    ``gravity`` (3,) m/s^2 is in our axes. After :meth:`update` the arrays ``lengths`` (m,), in m,
    ``arms`` (m, 24), dl/dq in m/rad, ``inertia`` (24, 24) and ``bias`` (24,) belong to the state.
    """

    def __init__(self, neck: Neck, gravity: Floats | None = None) -> None:
        self.neck = neck
        self._mujoco = import_mujoco()
        down = np.array([0.0, -GRAVITY, 0.0]) if gravity is None else gravity
        self.model = self._mujoco.MjModel.from_xml_string(mjcf(neck, down))
        self.data = self._mujoco.MjData(self.model)
        self.q: Floats = self.data.qpos
        self.v: Floats = self.data.qvel
        self.inertia: Floats = np.zeros((DOFS, DOFS))
        self.update()

    def update(self, ahead: Floats | float = 0.0) -> None:
        """Bring what depends on the state up to date; the bias is that of v + ``ahead``."""
        mujoco = self._mujoco
        model = self.model
        data = self.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_fullM(model, data, self.inertia)
        self.v += ahead
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        self.v -= ahead

    @property
    def bias(self) -> Floats:
        """Return C(q, v) and gravity (24,) in N m: M q'' + bias is what acts on the joints."""
        return np.asarray(self.data.qfrc_bias)

    @property
    def lengths(self) -> Floats:
        """Return the muscles' lengths (m,) in m."""
        return np.asarray(self.data.ten_length)

    @property
    def arms(self) -> Floats:
        """Return the moment arms dl/dq (m, 24) in m/rad."""
        model = self.model
        made = np.zeros((model.ntendon, DOFS))
        rows = np.repeat(np.arange(model.ntendon), model.ten_J_rownnz)
        made[rows, model.ten_J_colind] = self.data.ten_J
        return made

    @property
    def energy(self) -> float:
        """Return the energy of motion and of height in J."""
        heights = self.data.xipos[1:] @ self.model.opt.gravity
        return float(self.v @ self.inertia @ self.v / 2.0 - self.model.body_mass[1:] @ heights)

    def set_pose(self, turns: Floats, v: Floats | None = None) -> None:
        """Go to joints turned by rotation vectors (8, 3), with velocities (24,), 0 for None."""
        self.q[:] = quaternions(turns)
        self.v[:] = 0.0 if v is None else v
        self.update()

    def pose(self) -> NeckPose:
        """Return where the bodies are."""
        return self.neck.pose(self.turns)

    @property
    def turns(self) -> Floats:
        """Return the joints' rotation vectors (8, 3)."""
        return rotation_vectors(self.q)

    @property
    def head(self) -> Floats:
        """Return the head's rotation (3, 3)."""
        return np.array(self.data.xmat[-1]).reshape(3, 3)

    def head_jacobian(self) -> Floats:
        """Return what takes v to the head's angular velocity in our axes, (3, 24)."""
        turned = np.array(self.data.xmat[1:]).reshape(JOINTS, 3, 3)
        return np.asarray(turned.transpose(1, 0, 2).reshape(3, DOFS))

    def head_drift(self) -> Floats:
        """Return the head's angular acceleration (3,) by v alone, where v' is 0."""
        turned = np.array(self.data.xmat[1:]).reshape(JOINTS, 3, 3)
        own = np.einsum("kij,kj->ki", turned, self.v.reshape(JOINTS, 3))
        whole = np.cumsum(own, axis=0)
        return np.asarray(np.cross(whole, own).sum(axis=0))

    def push(self, force: Floats, point: Floats) -> Floats:
        """Return the joints' torques (24,) of a ``force`` (3,) N at a rest point (3,) of the head.

        The point is mm.
        """
        mujoco = self._mujoco
        data = self.data
        at = data.xpos[-1] + self.head @ ((point - self.neck.centres[-1]) * MM)
        along = np.zeros((3, DOFS))
        mujoco.mj_jac(self.model, data, along, None, at, self.model.nbody - 1)
        return np.asarray(along.T @ force)


def quaternions(turns: Floats) -> Floats:
    """Return rotation vectors (8, 3) as MuJoCo's state (32,)."""
    quats = Rotation.from_rotvec(turns).as_quat()
    return np.asarray(np.roll(quats, 1, axis=1).ravel())


def rotation_vectors(q: Floats) -> Floats:
    """Return the rotation vectors (8, 3) of a state (32,)."""
    quats = np.roll(q.reshape(JOINTS, 4), -1, axis=1)
    return np.asarray(Rotation.from_quat(quats).as_rotvec())


def mjcf(neck: Neck, gravity: Floats) -> str:
    """Return a neck as a model of MuJoCo, lengths in m: bodies b1 ... b8, tendons in their order.

    There is no contact, and no force but gravity.
    """
    sites: dict[int, list[str]] = {number: [] for number in range(JOINTS + 1)}
    paths = []
    for number, muscle in enumerate(neck.muscles):
        names = []
        for step, (body, point) in enumerate(zip(muscle.bodies, muscle.points, strict=True)):
            origin = neck.centres[body - 1] if body else np.zeros(3)
            name = f"m{number}.{step}"
            at = _numbers((point - origin) * MM)
            sites[int(body)].append(f'<site name="{name}" pos="{at}"/>')
            names.append(f'<site site="{name}"/>')
        paths.append(f'<spatial name="m{number}">{"".join(names)}</spatial>')
    inside = ""
    for joint in reversed(range(JOINTS)):
        below = neck.centres[joint - 1] if joint else np.zeros(3)
        at = _numbers((neck.centres[joint] - below) * MM)
        centre = _numbers((neck.mass_centres[joint] - neck.centres[joint]) * MM)
        six = _numbers(neck.inertias[joint][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
        inside = (
            f'<body name="b{joint + 1}" pos="{at}"><joint type="ball"/>'
            f'<inertial pos="{centre}" mass="{neck.masses[joint]:.17g}" fullinertia="{six}"/>'
            f"{''.join(sites[joint + 1])}{inside}</body>"
        )
    return (
        f'<mujoco><compiler balanceinertia="true"/><option gravity="{_numbers(gravity)}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{''.join(sites[0])}{inside}</worldbody>"
        f"<tendon>{''.join(paths)}</tendon></mujoco>"
    )


def _numbers(values: Floats) -> str:
    return " ".join(f"{value:.17g}" for value in values)
